"""Objects that a worker keeps in memory, since reading one takes longer than several interactions with it."""

from collections import OrderedDict
from pathlib import Path

from collector.objects.articulation import ArticulatedObject
from collector.objects.catalogue import load_ref
from shared.config import Collision
from shared.plan import ObjectRef

MOST_BYTES = 256 << 20
"""Of meshes. The published objects take 0.1 to 5 MB each, so that some hundreds find room."""


class ObjectCache:
    """The objects of one folder, read when they are first asked for; those unused for longest make room.

    Args:
        folder: of the objects.
        most_bytes: of meshes to keep; the object that was asked for last stays, however large it is.
    """

    def __init__(self, folder: Path, most_bytes: int = MOST_BYTES) -> None:
        self.folder = folder
        self._most_bytes = most_bytes
        self._kept: OrderedDict[tuple[ObjectRef, Collision], ArticulatedObject] = OrderedDict()
        self._bytes = 0

    def load(self, ref: ObjectRef, collision: Collision) -> ArticulatedObject:
        """An object, as its reference knows it.

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
    """What an object's meshes take in memory, each counted once."""
    meshes = {id(mesh): mesh for body in target.bodies for mesh in (*body.visuals, *body.collisions)}
    return sum(mesh.vertices.nbytes + mesh.faces.nbytes for mesh in meshes.values())
