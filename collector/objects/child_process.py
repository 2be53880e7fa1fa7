"""Processes for libraries that may hang, crash or take too much memory on a strange mesh, and the messages to them.

A message is a length (unsigned 64 bits) and so many bytes; a question begins with the time for its answer (64 bits).
The parent calls `ChildProcess.ask`, and the module that the child runs calls `answer_all`.

`encode` makes bytes of a list of meshes, for these messages and for caches. They are checked when they are read, since
either may be cut or forged: count, then for each mesh: vertices, faces (unsigned 32 bits each), coordinates (64 bits),
indices (32 bits); the SHA-256 of all this at the end.
"""

import contextlib
import hashlib
import os
import signal
import struct
import subprocess
import sys
from collections.abc import Callable, Sequence
from typing import IO

import numpy as np

from collector.objects.articulation import Mesh
from shared.io.interpreter import PYTHON, own_environment

_LENGTH, _LIMIT = struct.Struct("<Q"), struct.Struct("<d")


MAX_ENCODED_BYTES = 256 << 20
_COUNT, _SIZES = struct.Struct("<I"), struct.Struct("<II")
_CHECKSUM_BYTES = 32


class ChildProcess:
    """Answers one question after another; is started by the first, and again by the next after it has ended."""

    def __init__(self, module: str, most_bytes: int) -> None:
        self._module = module
        self._most_bytes = most_bytes
        self._child: subprocess.Popen[bytes] | None = None
        self._code = 0

    def ask(self, question: bytes, limit_s: float) -> bytes:
        """Its answer.

        Args:
            question: as the module understands it.
            limit_s: CPU time for the answer. Time on the clock would make it depend on what else the machine does.

        Raises:
            EOFError: it has ended; `end` tells why.
            ValueError: the answer is too long.
        """
        child = self._running()
        assert child.stdin is not None
        assert child.stdout is not None
        try:
            _send(child.stdin, _LIMIT.pack(limit_s) + question)
        except BrokenPipeError:
            raise EOFError from None
        answer = _receive(child.stdout, self._most_bytes)
        if answer is None:
            raise EOFError
        return answer

    def end(self) -> bool:
        """End it, if it runs, after it failed; returns whether it took longer than it may."""
        if self._child is None:
            return False
        with contextlib.suppress(subprocess.TimeoutExpired):
            # One that failed is about to be gone, and how tells why.
            self._child.wait(0.2)
        self.close()
        return self._code == -signal.SIGPROF

    def close(self) -> None:
        """End it, if it runs."""
        if self._child is not None:
            self._child.kill()
            self._child.communicate()
            self._code, self._child = self._child.returncode, None

    def _running(self) -> "subprocess.Popen[bytes]":
        if self._child is None or self._child.poll() is not None:
            self._child = subprocess.Popen(
                [*PYTHON, "-m", self._module],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                # Sums over several threads would depend on how many there are.
                env={**own_environment(), "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
            )
        return self._child


def answer_all(answer: Callable[[bytes], bytes], most_bytes: int) -> None:
    """Answer the questions on the standard input until it ends.

    The signal at the end of an answer's time ends the process. Whatever a library prints does not end up among the
    answers.

    Args:
        answer: gives the answer to a question.
        most_bytes: of a question.

    Raises:
        ValueError: a question is too long.
    """
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    while (message := _receive(sys.stdin.buffer, _LIMIT.size + most_bytes)) is not None:
        (limit_s,) = _LIMIT.unpack_from(message)
        signal.setitimer(signal.ITIMER_PROF, limit_s)
        found = answer(message[_LIMIT.size :])
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        _send(answers, found)


def _send(stream: IO[bytes], data: bytes) -> None:
    stream.write(_LENGTH.pack(len(data)) + data)
    stream.flush()


def _receive(stream: IO[bytes], most_bytes: int) -> bytes | None:
    """The next message; None where the stream ends before it.

    Raises:
        ValueError: it is longer than it may be.
    """
    head = stream.read(_LENGTH.size)
    if len(head) < _LENGTH.size:
        return None
    (length,) = _LENGTH.unpack(head)
    if length > most_bytes:
        raise ValueError("a message is too long")
    return stream.read(length)


def encode(meshes: Sequence[Mesh]) -> bytes:
    """The bytes of `meshes`: the same for the same meshes."""
    body = [_COUNT.pack(len(meshes))]
    for mesh in meshes:
        body += [
            _SIZES.pack(len(mesh.vertices), len(mesh.faces)),
            np.ascontiguousarray(mesh.vertices, dtype="<f8").tobytes(),
            np.ascontiguousarray(mesh.faces, dtype="<i4").tobytes(),
        ]
    data = b"".join(body)
    return data + hashlib.sha256(data).digest()


def decode(data: bytes) -> tuple[Mesh, ...]:
    """The meshes that `data` holds.

    Raises:
        ValueError: it is cut, damaged or none of ours, or a mesh is not finite or names vertices that are not there.
    """
    body = memoryview(data)[:-_CHECKSUM_BYTES]
    if len(data) < _COUNT.size + _CHECKSUM_BYTES or hashlib.sha256(body).digest() != data[-_CHECKSUM_BYTES:]:
        raise ValueError("the checksum does not fit")
    (count,), place, meshes = _COUNT.unpack_from(body), _COUNT.size, []
    for _ in range(count):
        if len(body) < place + _SIZES.size:
            raise ValueError("a mesh is missing")
        vertex_count, face_count = _SIZES.unpack_from(body, place)
        place += _SIZES.size
        middle, end = place + 24 * vertex_count, place + 24 * vertex_count + 12 * face_count
        if len(body) < end:
            raise ValueError("a mesh is cut")
        vertices = np.frombuffer(body[place:middle], dtype="<f8").reshape(-1, 3).astype(np.float64)
        faces = np.frombuffer(body[middle:end], dtype="<i4").reshape(-1, 3).astype(np.int32)
        if not np.isfinite(vertices).all() or (len(faces) and not 0 <= faces.min() <= faces.max() < vertex_count):
            raise ValueError("a mesh is not finite, or names vertices that are not there")
        meshes.append(Mesh(vertices, faces))
        place = end
    if place != len(body):
        raise ValueError("there is more than the meshes")
    return tuple(meshes)
