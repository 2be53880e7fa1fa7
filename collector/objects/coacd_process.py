"""A process that decomposes meshes by CoACD, one after another, until its standard input ends.

Each message, either way, is a list of meshes (`encode`): one mesh in, its convex pieces out. The library cannot be
interrupted, and a strange mesh may end its process, so it runs in a separate one.
"""

import coacd

from collector.objects.articulation import Mesh
from collector.objects.child_process import MAX_ENCODED_BYTES, answer_all, decode, encode

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


def _answer(question: bytes) -> bytes:
    (mesh,) = decode(question)
    found = coacd.run_coacd(coacd.Mesh(mesh.vertices, mesh.faces), **SETTINGS)
    return encode([Mesh(vertices, faces) for vertices, faces in found])


def main() -> None:
    """Decompose what comes in, one mesh after another."""
    coacd.set_log_level("off")
    answer_all(_answer, MAX_ENCODED_BYTES)


if __name__ == "__main__":
    main()
