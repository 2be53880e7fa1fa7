"""The page of a scan: its points and normals, and marks of the movable points that clicks make."""

from pathlib import Path
from typing import Any

import numpy as np
import viser

from adaafford.scans import Scan, ScanFrame, observation_of
from cluster.viewing.beliefs import Beliefs, Quantity, value_colours
from cluster.viewing.marking import Eye, Marking
from cluster.viewing.server import Page, small
from shared.policies.policy import Policy

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
