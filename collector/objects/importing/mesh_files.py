"""Mesh files of the formats that are imported: OBJ and STL by this project, COLLADA, glTF and PLY by trimesh."""

from pathlib import PurePosixPath

import numpy as np

from collector.objects import meshes
from collector.objects.articulation import Mesh
from collector.objects.child_process import ChildProcess, decode
from shared.errors import ObjectError
from shared.extras import require_packages
from shared.io.text import plain
from shared.urdf import MESH_ENDINGS

FOREIGN_ENDINGS = {".dae": ("trimesh", "pycollada"), ".glb": ("trimesh",), ".ply": ("trimesh",)}
"""Endings of files that other packages read, and these packages."""
ENDINGS = (*MESH_ENDINGS, *FOREIGN_ENDINGS)
LIMIT_S = 60.0
"""CPU time for one file."""
ENDING_BYTES = 8
"""Of the ending, with blanks after it, which a question begins with."""
TOO_LARGE = b"l"
"""An answer: the file needs too much memory."""
_MOST_ANSWER, _MOST_SAID = 4 << 30, 120


class MeshParser:
    """Reads mesh files; a context that ends the process it may have started."""

    def __init__(self) -> None:
        self._child = ChildProcess("collector.objects.importing.mesh_process", _MOST_ANSWER)

    def __enter__(self) -> "MeshParser":
        return self

    def __exit__(self, *_: object) -> None:
        self._child.close()

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
        try:
            answer = self._child.ask(ending.encode().ljust(ENDING_BYTES) + data, LIMIT_S)
            if answer[:1] == b"m":
                (mesh,) = decode(answer[1:])
                return mesh
        except (EOFError, ValueError):
            answer = b""
        if not answer:
            if self._child.end():
                raise meshes.MeshSizeError(f"{name}: cannot be read within {LIMIT_S:g} s; convert it to OBJ")
            raise ObjectError(f"{name}: cannot be read; convert it to OBJ")
        if answer == TOO_LARGE:
            raise meshes.MeshSizeError(f"{name}: needs too much memory; convert it to OBJ")
        said = plain(" ".join(answer[1:].decode("utf-8", "replace").split()), _MOST_SAID)
        raise ObjectError(f"{name}: cannot be read ({said})")


def capsule(radius: float, half_length: float) -> Mesh:
    """A cylinder about the z axis, centred at the origin, with a half sphere on each end."""
    # With an odd number of rings none is on the equator, and its neighbours become the cylinder's edges.
    ball = meshes.sphere(radius, rings=13)
    return Mesh(ball.vertices + np.sign(ball.vertices * [0, 0, 1]) * half_length, ball.faces)
