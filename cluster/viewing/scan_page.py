"""The page of a scan: its points and normals, and marks of the movable points, saved as `adaafford adapt` reads them.

Shapes: M points of the scan, W working points: all of them, or an even sample of a large scan.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from adaafford.scans import Scan, ScanFrame, npz_of, observation_of
from cluster.viewing.beliefs import Beliefs, Quantity, value_colours
from cluster.viewing.server import Page, small
from shared.errors import UsageError
from shared.geometry import estimated_normals
from shared.io.files import create_exclusively, write_atomically, writing
from shared.policies.policy import Policy
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


MOVABLE, PLAIN, NORMAL = (255, 110, 20), (200, 204, 210), (40, 90, 220)
NORMALS = 800
"""Drawn at the most."""
SURFACE, BALL = "smooth surface", "ball"


class ScanPage(Page):
    """The page of a scan.

    Args:
        server: that shows it.
        scan: of the file.
        frame: how it lies in the world.
        out: the file to save to.
        overwrite: whether a file of this name is replaced.
        policy: whose affordance can be shown, if there is one.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        scan: Scan,
        frame: ScanFrame,
        out: Path,
        *,
        overwrite: bool,
        policy: Policy | None,
    ) -> None:
        super().__init__(server)
        self.marking, self.frame, self.out, self.overwrite = Marking(scan), frame, out, overwrite
        self.beliefs = None if policy is None else Beliefs({"policy": lambda: policy})
        self._size = float(np.ptp(self.marking.points, axis=0).max())
        self._add_controls()
        server.scene.set_up_direction(frame.up)
        server.scene.on_click()(lambda event: self.click(event.ray_origin, event.ray_direction))
        server.scene.on_rect_select(modifier="shift")(self._select)
        middle = self.marking.points.mean(axis=0)
        self.look_at(middle, np.array(frame.camera) - middle, self._size)
        self._draw()

    def _add_controls(self) -> None:
        gui, size = self.server.gui, self._size
        with gui.add_folder("Mark what is movable"):
            gui.add_html(small("Click on a part, or drag a box with Shift. A drag without Shift turns the view."))
            self.movable = gui.add_checkbox("Movable", True, hint="Off: clicks take marks away.")
            self.tool = gui.add_dropdown("Click marks", (SURFACE, BALL))
            step = size / 200
            self.radius = gui.add_slider("Radius, m", step, 2 * size, step, 2 * size)
            self.angle = gui.add_slider("Bend, deg", 1.0, 60.0, 1.0, 15.0, hint="Between neighbouring points.")
            undo = gui.add_button("Undo")
            clear = gui.add_button("Clear")
            save = gui.add_button("Save", color="green")
            self.facts = gui.add_html("")
        with gui.add_folder("Show"):
            self.normals = gui.add_checkbox("Normals", False)
            self.affordance = gui.add_checkbox("Affordance", False, visible=self.beliefs is not None)
            self.scale = gui.add_html("")
        self.on(self.tool, call=lambda: self.put(self.radius, 2 * size if self.tool.value == SURFACE else 10 * step))
        self.on(undo, call=self._undo)
        self.on(clear, call=lambda: self._mark(np.ones(len(self.marking.points), bool), movable=False))
        self.on(save, call=self._save)
        self.on(self.normals, self.affordance, call=self._draw)

    def click(self, origin: Any, direction: Any) -> None:
        """Mark what a ray hits, both [3]."""
        with self.lock:
            point = self.marking.pick(np.array(origin), np.array(direction))
            if point is None:
                self.say("no point is there")
                return
            angle = float(self.angle.value) if self.tool.value == SURFACE else None
            self.say("")
            self._mark(self.marking.region(point, float(self.radius.value), angle), movable=self.movable.value)

    def _select(self, event: viser.SceneRectSelectEvent) -> None:
        """Mark what is in a box of the screen."""
        camera = event.client.camera
        rotation = viser.transforms.SO3(camera.wxyz).as_matrix().astype(np.float64)
        eye = Eye(camera.position, rotation, camera.fov, camera.aspect)
        with self.lock:
            self.say("")
            self._mark(self.marking.box(eye, event.screen_min, event.screen_max), movable=self.movable.value)

    def _mark(self, region: Any, *, movable: bool) -> None:
        self.marking.mark(region, movable=movable)
        self._draw()

    def _undo(self) -> None:
        if not self.marking.undo():
            self.say("there is nothing to undo")
        self._draw()

    def _save(self) -> None:
        count = self.marking.save(self.out, overwrite=self.overwrite)
        # Later changes replace our own file.
        self.overwrite = True
        self.say(f"saved {count} movable points of {len(self.marking.scan.points)} to {self.out}")

    def _draw(self) -> None:
        marking, scene = self.marking, self.server.scene
        points = np.asarray(marking.points, np.float32)
        # Lit from the direction of the camera, since a cloud of one colour has no shape.
        towards = np.array(self.frame.camera) - points.mean(axis=0)
        light = 0.4 + 0.6 * np.abs(marking.normals @ (towards / max(float(np.linalg.norm(towards)), 1e-9)))
        colours = (np.where(marking.movable[:, None], MOVABLE, PLAIN) * light[:, None]).astype(np.uint8)
        self.scale.content = ""
        with self.server.atomic():
            scene.remove_by_name("/normals")
            if self.affordance.value:
                points, colours = self._affordance()
            # Wide enough to close the gaps of an even cloud, and to be seen in a sparse one.
            wide = float(np.clip(1.2 * marking.spacing, self._size / 600, self._size / 100))
            scene.add_point_cloud("/cloud", points, colours, point_size=wide, point_shape="circle", precision="float32")
            if self.normals.value:
                some = np.linspace(0, len(marking.points) - 1, min(NORMALS, len(marking.points))).astype(int)
                ends = np.stack([marking.points[some], marking.points[some]], axis=1)
                ends[:, 1] += 0.04 * self._size * marking.normals[some]
                scene.add_line_segments("/normals", ends.astype(np.float32), NORMAL, thickness=0.003 * self._size)
        marked = int(marking.movable.sum())
        self.facts.content = small(
            f"{marked} of {len(marking.points)} points are marked\nSave writes {self.out}, for `adaafford adapt`"
        )

    def _affordance(self) -> tuple[Any, Any]:
        """The policy's affordance without interactions, on the points that it sees, in the scan's frame."""
        assert self.beliefs is not None
        observation = observation_of(self.marking.marked(), self.frame)
        self.beliefs.look_at(observation, [])
        within = self.beliefs.range_of(("policy",), Quantity.AFFORDANCE)
        values = self.beliefs.values("policy", Quantity.AFFORDANCE, 0)
        self.scale.content = small(f"affordance: violet {within[0]:.3f} to yellow {within[1]:.3f}")
        points = self.frame.point_to_scan(observation.points.astype(np.float64))
        return points.astype(np.float32), value_colours(values, within, observation.movable, Quantity.AFFORDANCE)
