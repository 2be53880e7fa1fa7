"""Marks of the movable points of a scan, made with a few clicks, and saved as `adaafford adapt` reads them.

Shapes: M points of the scan, W working points: all of them, or an even sample of a large scan.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from adaafford.scans import Scan, npz_of
from shared.errors import UsageError
from shared.geometry import estimated_normals
from shared.io.files import create_exclusively, write_atomically, writing
from shared.types import Float

WORKING_POINTS = 100_000
_NEIGHBOURS = 12
_GAP = 4.0
"""Points farther apart than so many times the usual distance are not neighbours."""
_TOLERANCE_RAD = 0.01
"""How far a click may miss a point."""

Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Eye:
    """From where a browser looks at a scan.

    Attributes:
        place: [3], in the scan's frame.
        rotation: [3, 3], columns right, down, forward.
        field_of_view_rad: vertical.
        aspect: width of the screen over its height.
    """

    place: Float
    rotation: Float
    field_of_view_rad: float
    aspect: float


class Marking:
    """Which points of a scan are movable; all changes can be undone.

    Args:
        scan: a scan whose own marks, if it has any, are the first ones; otherwise nothing is marked.

    Attributes:
        points: [W, 3], in the scan's frame.
        normals: [W, 3], unit length, of either sign.
        movable: [W].
        spacing: usual distance between neighbours, m.
    """

    def __init__(self, scan: Scan) -> None:
        self.scan = scan
        count = len(scan.points)
        index = np.linspace(0, count - 1, min(count, WORKING_POINTS)).astype(np.int64)
        self.points = scan.points[index]
        self.movable = np.zeros(len(index), bool) if scan.movable is None else scan.movable[index]
        normals = np.zeros_like(self.points) if scan.normals is None else scan.normals[index]
        lengths = np.linalg.norm(normals, axis=1, keepdims=True)
        unknown = lengths[:, 0] < 1e-9
        self.normals = normals / np.maximum(lengths, 1e-9)
        if unknown.any():
            self.normals[unknown] = estimated_normals(self.points, self.points[unknown])
        self._tree = cKDTree(self.points)
        distances, near = map(np.asarray, self._tree.query(self.points, k=_NEIGHBOURS + 1))
        self.spacing = float(np.median(distances[:, 1]))
        self._near = np.where(distances <= max(_GAP * self.spacing, 1e-9), near, np.arange(len(index))[:, None])[:, 1:]
        self._undone = list[Mask]()

    def pick(self, origin: Float, direction: Float) -> int | None:
        """The working point that a ray hits first; None: it misses all."""
        offsets = self.points - origin
        along = offsets @ (direction / np.linalg.norm(direction))
        aside = np.sqrt(np.maximum((offsets**2).sum(axis=1) - along**2, 0.0))
        hit = np.flatnonzero((along > 0) & (aside <= np.maximum(1.5 * self.spacing, _TOLERANCE_RAD * along)))
        if not len(hit):
            return None
        first = hit[along[hit] <= along[hit].min() + 3 * self.spacing]
        return int(first[aside[first].argmin()])

    def region(self, point: int, radius: float, angle_deg: float | None = None) -> Mask:
        """The working points within `radius` of one, [W].

        Args:
            point: index of the point.
            radius: m.
            angle_deg: only those that a path over neighbours leads to on which normals turn by at most so much from
                one point to the next; None: all.
        """
        inside = np.zeros(len(self.points), bool)
        inside[self._tree.query_ball_point(self.points[point], radius)] = True
        inside[point] = True
        if angle_deg is None:
            return inside
        begin, end = np.repeat(np.arange(len(self.points)), _NEIGHBOURS), self._near.ravel()
        kept = inside[begin] & inside[end]
        begin, end = begin[kept], end[kept]
        cosines = np.abs((self.normals[begin] * self.normals[end]).sum(axis=1))
        smooth = cosines >= np.cos(np.deg2rad(angle_deg)) - 1e-9
        edges = (np.ones(smooth.sum(), bool), (begin[smooth], end[smooth]))
        _, labels = connected_components(coo_array(edges, shape=(len(inside), len(inside))), directed=False)
        return np.asarray(labels == labels[point])

    def box(self, eye: Eye, low: tuple[float, float], high: tuple[float, float]) -> Mask:
        """The working points in a box of the screen, [W]; low and high from 0, 0 (upper left) to 1, 1."""
        seen = (self.points - eye.place) @ eye.rotation
        reach = np.tan(eye.field_of_view_rad / 2) * np.maximum(seen[:, 2:], 1e-9) * np.array([eye.aspect, 1.0])
        places = (seen[:, :2] / reach + 1) / 2
        inside: Mask = (seen[:, 2] > 0) & (places >= low).all(axis=1) & (places <= high).all(axis=1)
        return inside

    def mark(self, region: Mask, *, movable: bool) -> None:
        """Mark working points, [W], as movable or not."""
        self._undone.append(self.movable)
        self.movable = np.where(region, movable, self.movable)

    def undo(self) -> bool:
        """Take the last change back; False: there is none."""
        if not self._undone:
            return False
        self.movable = self._undone.pop()
        return True

    def marked(self) -> Scan:
        """The scan with the marks; a point that is no working point has the mark of the nearest one.

        Raises:
            UsageError: nothing is marked.
        """
        if not self.movable.any():
            raise UsageError("no point is marked as movable; click on the part to act on")
        all_shown = len(self.points) == len(self.scan.points)
        movable = self.movable if all_shown else self.movable[self._tree.query(self.scan.points)[1]]
        return replace(self.scan, movable=movable)

    def save(self, path: Path, *, overwrite: bool) -> int:
        """Write the scan with the marks as NPZ, each point in its row; returns how many points are movable.

        Raises:
            UsageError: nothing is marked, a file of this name is there, or it cannot be written.
        """
        marked = self.marked()
        data = npz_of(marked)
        with writing(path, "name another place by --out"):
            if overwrite:
                write_atomically(path, data)
            elif not create_exclusively(path, data):
                raise UsageError(f"{path}: is there already; start again with another --out, or with --overwrite")
        assert marked.movable is not None
        return int(marked.movable.sum())
