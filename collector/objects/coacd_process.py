"""A process that decomposes meshes by CoACD, one after another, until its standard input ends.

Each message, either way, is a length (unsigned 64 bits) and a list of meshes (`collector.objects.mesh_bytes`): one
mesh in, its convex pieces out. The library cannot be interrupted, and a strange mesh may end its process, so it runs
in a separate one.
"""

import os
import signal
import struct
import sys
from typing import IO

import coacd

from collector.objects.articulation import Mesh
from collector.objects.mesh_bytes import MAX_ENCODED_BYTES, decode, encode

LENGTH = struct.Struct("<Q")
MAX_PIECES = 16
"""Of one mesh."""
SETTINGS: dict[str, float | int | bool] = {
    "threshold": 0.05,  # How far a piece may be from its hull.
    "real_metric": True,  # The threshold is in the object's units instead of shares of the mesh's size.
    "max_convex_hull": MAX_PIECES,
    "preprocess_resolution": 30,  # Meshes that are no closed surfaces are made such on a grid this fine.
    "resolution": 500,
    "mcts_nodes": 10,
    "mcts_iterations": 60,
    "mcts_max_depth": 2,
    "seed": 0,
}
"""What determines the pieces; part of what cached pieces are known by."""


def send(stream: IO[bytes], meshes: list[Mesh]) -> None:
    """Write one message."""
    data = encode(meshes)
    stream.write(LENGTH.pack(len(data)) + data)
    stream.flush()


def receive(stream: IO[bytes]) -> tuple[Mesh, ...]:
    """Read one message.

    Raises:
        EOFError: the stream ends.
        ValueError: the message is malformed.
    """
    head = stream.read(LENGTH.size)
    if len(head) < LENGTH.size:
        raise EOFError
    (length,) = LENGTH.unpack(head)
    if length > MAX_ENCODED_BYTES:
        raise ValueError("a message is too long")
    return decode(stream.read(length))


def main() -> None:
    """Decompose what comes in, each mesh within as many seconds of CPU time as the first argument says."""
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    # Whatever the library prints must not end up among the answers.
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    coacd.set_log_level("off")
    while True:
        try:
            (mesh,) = receive(sys.stdin.buffer)
        except EOFError:
            return
        # Its signal ends the process. Time on the clock would make it depend on what else the machine does.
        signal.setitimer(signal.ITIMER_PROF, float(sys.argv[1]))
        found = coacd.run_coacd(coacd.Mesh(mesh.vertices, mesh.faces), **SETTINGS)
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        send(answers, [Mesh(vertices, faces) for vertices, faces in found])


if __name__ == "__main__":
    main()
