"""Convex decomposition of collision meshes, so that cavities stay open: by CoACD, once a mesh, cached by its content.

    opened = Decomposer(cache_folder("pieces")).decomposed(target)

The cache is shared by all processes of a machine. Its entries are checked like any file from outside: what is damaged
or does not fit its mesh is computed again.
"""

import dataclasses
import hashlib
import json
from collections.abc import Callable, Sequence
from importlib.metadata import version
from pathlib import Path

import numpy as np

from collector.objects.articulation import ArticulatedObject, Body, Mesh, check_bounds
from collector.objects.child_process import MAX_ENCODED_BYTES, ChildProcess, decode, encode
from collector.objects.coacd_process import MAX_PIECES, SETTINGS
from shared.errors import ObjectError, StoreError
from shared.io.files import read_bounded, remove_tree, write_atomically, writing

LIMIT_S = 120.0
"""CPU time for one mesh; the largest of published objects take some 20 s."""
MAX_MESH_TRIANGLES = 200_000
FLAT = 1e-4
"""What is thinner than this holds no cavity."""
SLACK = 0.1
"""How far pieces may stand out of their mesh's bounding box: preprocessing thickens surfaces."""


class Decomposer:
    """Decomposes objects in a child process; a context manager that ends this process.

    Args:
        cache: folder of the cache, created if missing.

    Example:
        >>> with Decomposer(cache_folder("pieces")) as decomposer:
        ...     opened = decomposer.decomposed(target)
    """

    def __init__(self, cache: Path) -> None:
        self._cache = cache
        self._child = ChildProcess("collector.objects.coacd_process", MAX_ENCODED_BYTES)
        self._salt = json.dumps([version("coacd"), SETTINGS], sort_keys=True).encode()

    def __enter__(self) -> "Decomposer":
        return self

    def __exit__(self, *_: object) -> None:
        self._child.close()

    def decomposed(
        self, target: ArticulatedObject, progress: Callable[[int, int], None] | None = None
    ) -> ArticulatedObject:
        """`target` with each collision mesh that has cavities replaced by convex pieces.

        Args:
            target: the object.
            progress: called with the number of finished meshes and the total.

        Raises:
            ObjectError: a mesh is too large, takes too long or ends the library, or there are too many pieces.
            UsageError: the cache cannot be written.
        """
        total, done = sum(len(body.collisions) for body in target.bodies), 0
        bodies: list[Body] = []
        for body in target.bodies:
            pieces: list[Mesh] = []
            for mesh in body.collisions:
                try:
                    pieces.extend(self.pieces(mesh))
                except ObjectError as error:
                    raise ObjectError(f"object {target.ref.id}, link '{body.link}': {error}") from None
                done += 1
                if progress is not None:
                    progress(done, total)
            bodies.append(dataclasses.replace(body, collisions=tuple(pieces)))
        try:
            check_bounds(bodies)
        except ObjectError as error:
            raise ObjectError(f"object {target.ref.id}, decomposed: {error}") from None
        return dataclasses.replace(target, bodies=tuple(bodies))

    def pieces(self, mesh: Mesh) -> tuple[Mesh, ...]:
        """The convex pieces of one mesh; the mesh itself if one piece is enough.

        Raises:
            ObjectError: it is too large, takes too long or ends the library.
            UsageError: the cache cannot be written.
        """
        if _is_flat(mesh):
            return (mesh,)
        if len(mesh.faces) > MAX_MESH_TRIANGLES:
            raise ObjectError(f"a mesh of {len(mesh.faces)} triangles; at most {MAX_MESH_TRIANGLES} are decomposed")
        key = hashlib.sha256(self._salt + encode([mesh])).hexdigest()
        path = self._cache / key[:2] / key
        found = _cached(path, mesh)
        if found is None:
            found = self._computed(mesh)
            _keep(path, found)
        return found or (mesh,)

    def _computed(self, mesh: Mesh) -> tuple[Mesh, ...]:
        """The pieces, or none where one is enough."""
        try:
            found = decode(self._child.ask(encode([mesh]), LIMIT_S))
        except (EOFError, ValueError):
            what = (
                f"takes longer than {LIMIT_S:g} s to decompose"
                if self._child.end()
                else "cannot be decomposed by CoACD"
            )
            raise ObjectError(f"a mesh of {len(mesh.faces)} triangles {what}; use convex hulls") from None
        if len(found) <= 1:
            return ()
        if not _fits(found, mesh):
            raise ObjectError("CoACD's pieces do not fit their mesh; use convex hulls")
        return found


def _is_flat(mesh: Mesh) -> bool:
    """Whether all vertices lie in a plane, about: such a mesh has no cavity, and CoACD may not end on it."""
    spread = np.linalg.svd(mesh.vertices - mesh.vertices.mean(axis=0), compute_uv=False)
    return len(mesh.vertices) < 4 or bool(spread[-1] / np.sqrt(len(mesh.vertices)) < FLAT)


def _fits(pieces: Sequence[Mesh], mesh: Mesh) -> bool:
    """Whether there are few enough pieces, each with vertices, about where the mesh is."""
    low, high = mesh.vertices.min(axis=0) - SLACK, mesh.vertices.max(axis=0) + SLACK
    return len(pieces) <= MAX_PIECES and all(
        len(piece.vertices) >= 4 and (piece.vertices >= low).all() and (piece.vertices <= high).all()
        for piece in pieces
    )


def _cached(path: Path, mesh: Mesh) -> tuple[Mesh, ...] | None:
    """The pieces of a cache entry; None where there is none that is sound."""
    try:
        found = decode(read_bounded(path, MAX_ENCODED_BYTES))
    except (StoreError, ValueError):
        return None
    return found if len(found) != 1 and _fits(found, mesh) else None


def _keep(path: Path, pieces: tuple[Mesh, ...]) -> None:
    """Put pieces into the cache."""
    with writing(path.parent, "set XDG_CACHE_HOME to a folder that can"):
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.is_dir():
            remove_tree(path)
        write_atomically(path, encode(pieces))
