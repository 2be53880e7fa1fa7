"""Readers of objects: one for each layout of files, found by name; docs/extending.md says how a package adds one.

Whatever the reader, an object's files are read through `ObjectFiles`, its content hash covers what was read, and bounds
and shapes are checked before anything else sees it.
"""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
from pydantic import ValidationError

from collector.objects.articulation import MIN_RANGE, ArticulatedObject, Body, Joint, check_bounds
from collector.objects.files import ObjectFiles
from shared.errors import ObjectError
from shared.extensions import Registry
from shared.io.text import short
from shared.plan import ObjectRef

MAX_WORD = 64


@dataclass(frozen=True, slots=True)
class Description:
    """The result of a reader.

    Attributes:
        category: of the object, such as "Box"; up to 64 printable characters.
        bodies: the root, then the movable parts, parents before children.
        notes: messages for the user about files that were left out or interpreted differently, one phrase each.
        content_hash: SHA-256 of everything that determines the object; None: of the names and contents of the files
            that were read.
    """

    category: str
    bodies: tuple[Body, ...]
    notes: tuple[str, ...] = ()
    content_hash: str | None = None


@runtime_checkable
class ObjectReader(Protocol):
    """Reads the objects of one layout, from untrusted files."""

    def matches(self, folder: Path) -> bool:
        """Whether the folder looks like an object of this layout; only looks at names."""
        ...

    def read(self, files: ObjectFiles) -> Description:
        """The object in `files.folder`.

        Raises:
            ObjectError: with one line that says what is wrong with the object's files.
        """
        ...


READERS = Registry("object reader", ObjectReader, {"partnet-mobility": "collector.objects.partnet:READER"})  # type: ignore[type-abstract]
"""In the order in which they are asked; packages add others by entry points of "adaafford.object_readers"."""


def reader_of(folder: Path) -> str | None:
    """The name of the first reader whose layout the folder has; None if the folder has no object."""
    return next((name for name in READERS.names() if READERS.get(name).matches(folder)), None)


def read_object(folder: Path, tree: Path | None = None) -> ArticulatedObject:
    """Read and check one object; the folder's name is its id.

    Args:
        folder: of the object.
        tree: the folder of objects that the user named, below which links are followed; default: `folder`.

    Raises:
        ObjectError: with one line that says what is wrong with the object's files.
    """
    return read_files(ObjectFiles(folder, tree))


def read_files(files: ObjectFiles) -> ArticulatedObject:
    """The object in the folder of `files`; raises as `read_object` does."""
    folder = files.folder
    # The first reader says what is missing in a folder that has no layout at all.
    name = reader_of(folder) or READERS.names()[0]
    described = READERS.get(name).read(files)
    if not 0 < len(described.category) <= MAX_WORD or not described.category.isprintable():
        raise ObjectError(f"{folder}: the category {short(described.category)} needs 1 to {MAX_WORD} printable letters")
    try:
        # Of a link the name is its own, by which the object is found again below the folder of objects.
        ref = ObjectRef(
            id=folder.absolute().name,
            category=described.category,
            content_hash=_of_package(name, described.content_hash or files.digest()),
        )
    except ValidationError:
        raise ObjectError(
            f"{folder}: the folder's name is the object's id and may hold letters, digits, '.', '_' and '-', up to 100"
        ) from None
    try:
        _check_shapes(described.bodies)
        check_bounds(described.bodies)
    except ObjectError as error:
        raise ObjectError(f"{folder}: {error}") from None
    _require_a_movable_part(described.bodies, folder)
    return ArticulatedObject(ref, described.bodies, described.notes)


def alike(joints: Sequence[Joint]) -> str:
    """How the limits of joints that cannot move compare."""
    return "nearly the same" if any(joint.span for joint in joints) else "the same"


def _of_package(reader: str, content_hash: str) -> str:
    """With another version of the package that adds the reader, the same files may be another object."""
    package = READERS.package_of(reader)
    return content_hash if package is None else hashlib.sha256(f"{package} {content_hash}".encode()).hexdigest()


def _check_shapes(bodies: Sequence[Body]) -> None:
    """Refuse bodies that are not what `Body` says, whichever reader made them."""
    if len(bodies) < 2 or bodies[0].joint is not None:
        raise ObjectError("needs a root without a joint, and at least one part with one")
    for number, body in enumerate(bodies):
        joint = body.joint
        if number and (joint is None or not 0 <= joint.parent < number):
            raise ObjectError(f"link {short(body.link)} needs a joint to a body that comes before it")
        if joint is not None:
            numbers = (joint.parent_from_body, joint.axis, [joint.lower, joint.upper])
            if not all(np.isfinite(each).all() for each in numbers) or abs(np.linalg.norm(joint.axis) - 1) > 1e-6:
                raise ObjectError(f"joint {short(joint.name)}: numbers must be finite, and the axis of length 1")
        for mesh in (*body.visuals, *body.collisions):
            inside = not mesh.faces.size or (mesh.faces.min() >= 0 and mesh.faces.max() < len(mesh.vertices))
            if not inside or not np.isfinite(mesh.vertices).all():
                raise ObjectError(f"link {short(body.link)}: a mesh has vertices that are not finite, or lacks some")


def _require_a_movable_part(bodies: Sequence[Body], folder: Path) -> None:
    joints = [body.joint for body in bodies if body.joint is not None]
    moving = [body for body in bodies if body.joint is not None and body.joint.span > MIN_RANGE]
    if not moving:
        first = joints[0]
        raise ObjectError(
            f"{folder}: has no movable part: no joint can move, since the lower and the upper limit of each are "
            f"{alike(joints)} (such as {first.lower:g} and {first.upper:g} of {short(first.name)})"
        )
    if not any(body.visuals for body in moving):
        raise ObjectError(f"{folder}: has no movable part that can be seen: its moving links have no mesh")
