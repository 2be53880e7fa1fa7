"""Mesh files of the formats that are imported: OBJ and STL by this project, COLLADA, glTF and PLY by trimesh."""

import contextlib
import signal
import subprocess
from pathlib import PurePosixPath
from types import TracebackType

import numpy as np

from collector.objects import meshes
from collector.objects.articulation import Mesh
from collector.objects.mesh_bytes import decode
from collector.objects.urdf import MESH_ENDINGS
from shared.errors import ObjectError
from shared.extras import require_packages
from shared.io.interpreter import PYTHON, own_environment
from shared.io.text import plain

FOREIGN_ENDINGS = {".dae": ("trimesh", "pycollada"), ".glb": ("trimesh",), ".ply": ("trimesh",)}
"""Endings of files that other packages read, and these packages."""
ENDINGS = (*MESH_ENDINGS, *FOREIGN_ENDINGS)
LIMIT_S = 60.0
"""CPU time for one file."""
_LENGTH_BYTES, _MOST_SAID = 8, 120


class MeshParser:
    """Reads mesh files; a context that ends the process it may have started."""

    def __init__(self) -> None:
        self._child: subprocess.Popen[bytes] | None = None

    def __enter__(self) -> "MeshParser":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._end()

    def parse(self, data: bytes, name: str) -> Mesh:
        """The triangles of a file, by the ending of its name.

        Raises:
            MeshSizeError: the file is beyond a bound.
            ObjectError: it cannot be read, is not finite, or holds no face that has an area.
            UsageError: a package that reads this format is not installed.
        """
        ending = PurePosixPath(name).suffix.lower()
        if ending in MESH_ENDINGS:
            return meshes.parse_mesh(data, name)
        if ending not in FOREIGN_ENDINGS:
            raise ObjectError(f"{name}: no mesh file that can be read; allowed: {', '.join(ENDINGS)}")
        require_packages(f"reading {ending} meshes", *FOREIGN_ENDINGS[ending])
        if len(data) > meshes.MAX_OBJ_BYTES:
            raise meshes.MeshSizeError(f"{name}: {len(data)} bytes; at most {meshes.MAX_OBJ_BYTES} are allowed")
        mesh = self._read(data, name, ending)
        if not len(mesh.faces):
            raise ObjectError(f"{name}: no faces")
        return meshes.checked(mesh, name)

    def _read(self, data: bytes, name: str, ending: str) -> Mesh:
        child = self._running()
        assert child.stdin is not None
        assert child.stdout is not None
        try:
            child.stdin.write(len(data).to_bytes(_LENGTH_BYTES, "little") + ending.encode().ljust(8) + data)
            child.stdin.flush()
            length = int.from_bytes(child.stdout.read(_LENGTH_BYTES), "little")
            answer = child.stdout.read(length)
            if answer[:1] == b"m":
                (mesh,) = decode(answer[1:])
                return mesh
        except (BrokenPipeError, ValueError):
            answer = b""
        if not answer:
            slow = self._end() == -signal.SIGPROF
            raise ObjectError(f"{name}: cannot be read{f' within {LIMIT_S:g} s' if slow else ''}; convert it to OBJ")
        said = plain(" ".join(answer[1:].decode("utf-8", "replace").split()), _MOST_SAID)
        raise ObjectError(f"{name}: cannot be read ({said})")

    def _running(self) -> "subprocess.Popen[bytes]":
        if self._child is None or self._child.poll() is not None:
            self._child = subprocess.Popen(
                [*PYTHON, "-m", "collector.objects.importing.mesh_process", str(LIMIT_S)],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                env={**own_environment(), "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
            )
        return self._child

    def _end(self) -> int:
        """End the process, if there is one; returns its exit code, or minus the signal that it died of."""
        if self._child is None:
            return 0
        with contextlib.suppress(subprocess.TimeoutExpired):
            # One that failed is about to be gone, and how tells why.
            self._child.wait(0.2)
        self._child.kill()
        self._child.communicate()
        code, self._child = self._child.returncode, None
        return code


def capsule(radius: float, half_length: float) -> Mesh:
    """A cylinder about the z axis, centred at the origin, with a half sphere on each end."""
    # With an odd number of rings none is on the equator, and its neighbours become the cylinder's edges.
    ball = meshes.sphere(radius, rings=13)
    return Mesh(ball.vertices + np.sign(ball.vertices * [0, 0, 1]) * half_length, ball.faces)
