"""A process that reads meshes by trimesh, one after another, until its standard input ends.

A question is the file's ending (8 bytes, blanks at its end) and the file. An answer is "m" and a list of meshes
(`encode`), "e" and what is wrong, or `TOO_LARGE`. Files come from anybody, and the readers have no bounds of
their own, so they run in a process that has: on memory and on time.
"""

import json
import resource
import struct
from io import BytesIO
from xml.etree.ElementTree import Element

import defusedxml.ElementTree
import numpy as np
import trimesh

from collector.objects.articulation import Mesh
from collector.objects.child_process import answer_all, encode
from collector.objects.importing.mesh_files import ENDING_BYTES, TOO_LARGE
from collector.objects.meshes import MAX_OBJ_BYTES

MAX_MEMORY = 4 << 30
"""Bytes of address space beyond what the libraries take."""
_GLB_HEAD = struct.Struct("<4sIIII")


def read_mesh(data: bytes, ending: str) -> Mesh:
    """All triangles of a file, as one mesh, in metres where the format has units.

    Raises:
        ValueError: it is none of its format, or names other files.
    """
    scale = 1.0
    if ending == ".dae":
        scale = _unit(defusedxml.ElementTree.fromstring(data, forbid_dtd=True))
    elif ending == ".glb":
        _check_glb(data)
    scene = trimesh.load_scene(BytesIO(data), file_type=ending[1:], process=False, skip_materials=True)
    mesh = scene.to_mesh()
    vertices = np.array(mesh.vertices, dtype=np.float64) * scale
    if not np.isfinite(vertices).all():
        raise ValueError("a vertex is not finite")
    return Mesh(vertices, np.array(mesh.faces, dtype=np.int32))


def _unit(root: Element) -> float:
    """Metres of a COLLADA file's unit. As ROS does, nothing is turned for the axis that the file calls up."""
    unit = root.find("{*}asset/{*}unit")
    metres = 1.0 if unit is None else float(unit.get("meter", "1"))
    if not 0 < metres < 1e6:
        raise ValueError(f"a unit of {metres} metres")
    return metres


def _check_glb(data: bytes) -> None:
    """Refuse a file whose buffers or images are other files."""
    magic, _, _, length, _ = _GLB_HEAD.unpack_from(data)
    if magic != b"glTF":
        raise ValueError("no binary glTF")
    document = json.loads(data[_GLB_HEAD.size : _GLB_HEAD.size + length])
    for each in (*document.get("buffers", ()), *document.get("images", ())):
        if not str(each.get("uri", "data:")).startswith("data:"):
            raise ValueError("it names other files; export it as one self-contained file")


def _answer(question: bytes) -> bytes:
    try:
        return b"m" + encode([read_mesh(question[ENDING_BYTES:], question[:ENDING_BYTES].decode().rstrip())])
    except MemoryError:
        return TOO_LARGE
    except Exception as error:  # noqa: BLE001 - whatever a reader makes of a file from outside.
        return b"e" + f"{type(error).__name__}: {error}".encode("utf-8", "replace")


def main() -> None:
    """Read what comes in, one file after another."""
    with open("/proc/self/statm", encoding="ascii") as file:  # noqa: PTH123 - no regular file.
        taken = int(file.read().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (taken + MAX_MEMORY, taken + MAX_MEMORY))
    answer_all(_answer, ENDING_BYTES + MAX_OBJ_BYTES)


if __name__ == "__main__":
    main()
