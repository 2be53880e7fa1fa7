"""A cache of objects in memory, because reading an object takes longer than several interactions with it."""

from collections import OrderedDict
from pathlib import Path

from collector.objects.articulation import ArticulatedObject
from collector.objects.catalogue import load_ref
from shared.config import Collision
from shared.plan import ObjectRef

MOST_BYTES = 256 << 20
"""Of meshes. The published objects take 0.1 to 5 MB each, so that some hundreds find room."""


class ObjectCache:
    """The objects of one folder, read on demand; the least recently used ones are dropped.

    Args:
        folder: of the objects.
        most_bytes: of meshes to keep; the last object is kept in any case.
    """

    def __init__(self, folder: Path, most_bytes: int = MOST_BYTES) -> None:
        self.folder = folder
        self._most_bytes = most_bytes
        self._kept: OrderedDict[tuple[ObjectRef, Collision], ArticulatedObject] = OrderedDict()
        self._bytes = 0

    def load(self, ref: ObjectRef, collision: Collision) -> ArticulatedObject:
        """The object of a reference.

        Raises:
            ObjectError: see `collector.objects.catalogue.load_ref`.
        """
        key = ref, collision
        if key not in self._kept:
            self._kept[key] = load_ref(self.folder, ref, collision)
            self._bytes += mesh_bytes(self._kept[key])
        self._kept.move_to_end(key)
        while self._bytes > self._most_bytes and len(self._kept) > 1:
            _, dropped = self._kept.popitem(last=False)
            self._bytes -= mesh_bytes(dropped)
        return self._kept[key]


def mesh_bytes(target: ArticulatedObject) -> int:
    """Memory of an object's meshes, each counted once, bytes."""
    meshes = {id(mesh): mesh for body in target.bodies for mesh in (*body.visuals, *body.collisions)}
    return sum(mesh.vertices.nbytes + mesh.faces.nbytes for mesh in meshes.values())
