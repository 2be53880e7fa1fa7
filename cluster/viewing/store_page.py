"""The page of a store: its rollouts, the beliefs of policies about them, and interactions as they were simulated."""

import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import viser

from cluster.viewing.beliefs import Beliefs, Quantity, part_colours, told_before, value_colours
from cluster.viewing.browsing import Browser, Filters, Match, choices
from cluster.viewing.server import FAILURE, FORWARD, SUCCESS, Page, small, text
from shared.errors import AdaAffordError
from shared.extras import require
from shared.geometry import quaternion_from_rotation
from shared.io.text import plain
from shared.plan import InteractionRecord, RolloutRecord
from shared.policies.policy import Policy
from shared.store import Store
from shared.types import Float, Interaction, Observation, OutcomeKind

if TYPE_CHECKING:
    from collector.objects.articulation import Mesh
    from collector.viz.playback import Playback

ANY, NONE = "any", "none"
ARROW_SHARE, TOLD_SHARE, FORWARD_SHARE, POINT_SHARE = 0.28, 0.16, 0.12, 0.008
"""Sizes, as shares of the object's."""
FRAMES_A_SECOND = 30
BODY_COLOUR, PALM_COLOUR, FINGER_COLOUR = (165, 165, 165), (60, 60, 70), (255, 190, 0)
PART_COLOURS = ((76, 134, 184), (221, 132, 82), (85, 168, 104), (129, 114, 179))


class StorePage(Page):
    """The page of one or several stores.

    Args:
        server: that shows it.
        stores: by name; a run has two.
        policies: by name, each loaded when it is first used.
        compared: the policies that are shown first, at most two; without any, the colours are those of parts.
        objects: folder of the stores' objects; None: interactions cannot be simulated.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        stores: Mapping[str, Store],
        policies: Mapping[str, Callable[[], Policy]],
        compared: Sequence[str],
        objects: Path | None,
    ) -> None:
        super().__init__(server)
        self.stores, self.beliefs, self.objects = stores, Beliefs(policies), objects
        self._matches: dict[str, Match] = {}
        self._number = 0
        self._rollout: RolloutRecord | None = None
        self._history: list[Interaction] = []
        self._playback: Playback | None = None
        self._moving: list[Any] = []
        self._playing = False
        self._add_rollouts()
        self._add_interaction()
        self._add_beliefs(compared)
        self._add_simulation()
        with self.lock:
            self._open_store()
            self._look()

    def _add_rollouts(self) -> None:
        gui = self.server.gui
        with gui.add_folder("Rollouts"):
            self.source = gui.add_dropdown("Store", tuple(self.stores), visible=len(self.stores) > 1)
            self.rollout = gui.add_dropdown("Rollout", (NONE,), hint="With an interaction that meets the filters.")
            self.turn = gui.add_button_group("Page", ("previous", "next"))
            with gui.add_folder("Filters", expand_by_default=False):
                self.object = gui.add_dropdown("Object", (ANY,))
                self.outcome = gui.add_dropdown("Outcome", (ANY, *(kind.value for kind in OutcomeKind)))
                self.success = gui.add_dropdown("Success", (ANY, "success", "failure"))
                self.proposer = gui.add_dropdown("Proposer", (ANY,))
                self.version = gui.add_dropdown("Policy version", (ANY,), hint="Of the policy that proposed; 0: none.")
        self.on(self.source, call=self._open_store)
        self.on(self.object, self.outcome, self.success, self.proposer, self.version, call=self._filter)
        self.on(self.rollout, call=self._open_rollout)
        self.on(self.turn, call=lambda: self._open_page(self._number + _step(self.turn)))

    def _add_interaction(self) -> None:
        gui = self.server.gui
        with gui.add_folder("Interaction"):
            self.step = gui.add_slider("Number", 1, 2, 1, 1)
            self.jump = gui.add_button_group("Match", ("previous", "next"), hint="That meets the filters.")
            self.cloud = gui.add_checkbox("Show cloud", True)
            look = gui.add_button("Look from the camera")
        self.on(self.step, call=self._open_step)
        self.on(self.jump, call=lambda: self._jump(_step(self.jump)))
        self.on(self.cloud, call=self._draw)
        self.on(look, call=self._look)

    def _add_beliefs(self, compared: Sequence[str]) -> None:
        gui, names = self.server.gui, self.beliefs.names
        shown = [*compared, *names[: not compared], NONE, NONE]
        quantity = Quantity.AFFORDANCE if compared else Quantity.PARTS
        with gui.add_folder("Beliefs", visible=bool(names)):
            self.quantity = gui.add_dropdown("Colour", tuple(map(str, Quantity)), initial_value=str(quantity))
            self.policy = gui.add_dropdown("Policy", (*names, NONE), initial_value=shown[0])
            self.other = gui.add_dropdown("Compare with", (*names, NONE), initial_value=shown[1])
            self.known = gui.add_slider("Known", 0, 1, 1, 0, hint="How many interactions the policies know.")
            self.scale = gui.add_html("")
        self.on(self.quantity, self.policy, self.other, self.known, call=self._draw)

    def _add_simulation(self) -> None:
        gui = self.server.gui
        with gui.add_folder("Simulation"):
            self.simulate = gui.add_button("Simulate this interaction", disabled=self.objects is None)
            self.play = gui.add_button("Play / pause", disabled=True)
            self.frame = gui.add_slider("Frame", 0, 1, 1, 0, disabled=True)
            self.simulated = gui.add_html("" if self.objects else small("Needs --objects, the folder of the objects."))
        with gui.add_folder("Facts"):
            self.facts = gui.add_html("")
        self.on(self.simulate, call=self._simulate)
        self.on(self.frame, call=self._pose)
        self.on(self.play, call=self._play, alone=False)

    @property
    def store(self) -> Store:
        """The store that is shown."""
        return self.stores[self.source.value]

    @property
    def row(self) -> InteractionRecord:
        """The interaction that is shown."""
        assert self._rollout is not None
        return self._rollout.interactions[int(self.step.value) - 1]

    def _open_store(self) -> None:
        proposers, versions = choices(self.store)
        with self.silently():
            self.choose(self.object, (ANY, *sorted(ref.id for ref in self.store.setting.objects)))
            self.choose(self.proposer, (ANY, *map(plain, proposers)))
            self.choose(self.version, (ANY, *map(str, versions)))
        self._filter()

    def _filter(self) -> None:
        def chosen(dropdown: Any, read: Callable[[str], Any] = str) -> Any:
            return None if dropdown.value == ANY else read(dropdown.value)

        filters = Filters(
            object_id=chosen(self.object),
            outcome=chosen(self.outcome, OutcomeKind),
            success=chosen(self.success, "success".__eq__),
            proposer=chosen(self.proposer),
            policy_version=chosen(self.version, int),
        )
        self._browser = Browser(self.store, filters)
        self._open_page(0)

    def _open_page(self, number: int) -> None:
        if not self._browser.has_page(number):
            self.say("this is the first page" if number < 0 else "this is the last page")
            return
        self.say("searching ...")
        self._matches = {_named(match): match for match in self._browser.page(number)}
        self._number = number
        self.say("")
        with self.silently():
            self.choose(self.rollout, tuple(self._matches) or (NONE,))
        self._open_rollout()

    def _open_rollout(self) -> None:
        match = self._matches.get(self.rollout.value)
        self._rollout = None if match is None else self._browser.rollout(match)
        if match is None or self._rollout is None:
            self._forget_playback()
            self.server.scene.reset()
            self.facts.content = small("No interaction meets the filters.")
            return
        steps = [row.step for row in self._rollout.interactions]
        with self.silently():
            self.span(self.step, 1, len(steps), steps.index(match.steps[0]) + 1)
        self._open_step()

    def _open_step(self) -> None:
        if self._rollout is None:
            return
        self._forget_playback()
        self._history, before = told_before(self._rollout, self.row)
        self.beliefs.look_at(self._observation(), self._history)
        with self.silently():
            self.span(self.known, 0, len(self._history), before)
        self._draw()

    def _jump(self, way: int) -> None:
        """To the next interaction that meets the filters, or to the next rollout."""
        match = self._matches.get(self.rollout.value)
        if match is None or self._rollout is None:
            return
        ahead = [step for step in match.steps[::way] if way * step > way * self.row.step]
        if ahead:
            steps = [row.step for row in self._rollout.interactions]
            self.put(self.step, steps.index(ahead[0]) + 1)
            return
        names = list(self._matches)
        place = names.index(self.rollout.value) + way
        if 0 <= place < len(names):
            self.put(self.rollout, names[place])
        else:
            self._open_page(self._number + way)

    def _observation(self) -> Observation:
        assert self._rollout is not None
        return self._rollout.observations[self.row.observation]

    def _draw(self) -> None:
        if self._rollout is None:
            return
        observation, row, scene = self._observation(), self.row, self.server.scene
        size = _size(observation.points)
        quantity, panels = Quantity(self.quantity.value), self._panels()
        known = self._history[: int(self.known.value)] if quantity is not Quantity.PARTS else []
        with self.server.atomic():
            for place in range(2):
                scene.remove_by_name(f"/panel{place}")
            for place, (name, colours) in enumerate(panels):
                at = f"/panel{place}"
                scene.add_frame(at, show_axes=False, position=place * _aside(observation))
                if self.cloud.value:
                    points = np.asarray(observation.points, np.float32)
                    scene.add_point_cloud(
                        f"{at}/cloud", points, colours, point_size=POINT_SHARE * size, point_shape="circle"
                    )
                if self._playback is not None:
                    continue
                self.arrows(f"{at}/action", [row.action], [_colour(row.outcome.success)], ARROW_SHARE * size)
                ends = np.stack([row.action.point, row.action.point + FORWARD_SHARE * size * row.action.forward])
                self.vectors(f"{at}/forward", ends[None], FORWARD, FORWARD_SHARE * size)
                told = [each for each in known if each.action is not row.action]
                outcomes = [_colour(each.outcome.success) for each in told]
                self.arrows(f"{at}/known", [each.action for each in told], outcomes, TOLD_SHARE * size)
                if len(panels) > 1:
                    scene.add_label(f"{at}/label", plain(name, 60), position=(0.0, 0.0, 0.62 * size))
            self.facts.content = self._facts()

    def _panels(self) -> list[tuple[str, Any]]:
        """The clouds side by side: their titles, and the colours of their points."""
        observation, quantity = self._observation(), Quantity(self.quantity.value)
        names = [name for name in dict.fromkeys((self.policy.value, self.other.value)) if name != NONE]
        self.scale.content = ""
        if quantity is Quantity.PARTS or not names:
            return [("", part_colours(observation))]
        try:
            within = self.beliefs.range_of(names, quantity)
        except AdaAffordError as error:
            self.say(str(error), wrong=True)
            return [("", part_colours(observation))]
        known = int(self.known.value)
        values = {name: self.beliefs.values(name, quantity, known) for name in names}
        tasks = {name: self.beliefs.policy(name).task for name in names}
        others = [f"{name} is for the task {task}" for name, task in tasks.items() if task != self.store.setting.task]
        middles = [f"{name} {each[observation.movable].mean():.3f}" for name, each in values.items()]
        ends = ("blue", "red") if quantity is Quantity.CHANGE else ("violet", "yellow")
        lines = [
            f"{ends[0]} {within[0]:.3f} to {ends[1]} {within[1]:.3f}",
            f"mean after {known} of {len(self._history)} interactions: {', '.join(middles)}",
            *others,
        ]
        self.scale.content = small("\n".join(lines))
        return [(name, value_colours(each, within, observation.movable, quantity)) for name, each in values.items()]

    def _facts(self) -> str:
        """What is known of the interaction, and a line for each one of the rollout."""
        rollout, row = self._rollout, self.row
        assert rollout is not None
        dynamics, unit = rollout.dynamics, "rad" if np.any(row.joint_twist[:3]) else "m"
        hidden = ", ".join(f"{name} {value:.3g}" for name, value in dynamics.values.items())
        lines = [
            f"{row.outcome.kind}, {'success' if row.outcome.success else 'failure'}: "
            f"part {row.target_part} moved {row.outcome.motion:.3f} {unit}",
            f"{row.primitive}, proposed by {row.proposer}"
            + (f" with policy version {row.policy_version}" if row.policy_version else "")
            + (f", for the method {row.method} ({row.role})" if row.method else ""),
            f"hidden from policies: {hidden}, direction {dynamics.direction}",
        ]
        lines.append(f"object {rollout.object.id}, {plain(rollout.object.category, 40)}")
        match = self._matches[self.rollout.value]
        marks = "match" if len(match.steps) < len(rollout.interactions) else ""
        table = "".join(
            f"<tr style='color:rgb{_colour(each.outcome.success)};{'font-weight:bold' if each is row else ''}'>"
            f"<td>{'&rarr;' if each is row else ''}</td><td>{number}</td><td>{text(each.outcome.kind)}</td>"
            f"<td>{each.outcome.motion:.3f}</td><td>{text(each.proposer, 20)}</td>"
            f"<td>{marks if each.step in match.steps else ''}</td></tr>"
            for number, each in enumerate(rollout.interactions, 1)
        )
        return small("\n".join(lines)) + (
            "<div style='max-height:11em;overflow-y:auto;margin:0 1em 0.5em'>"
            f"<table style='font-size:0.75em;width:100%'>{table}</table></div>"
        )

    def _look(self) -> None:
        """Put all eyes where the camera was that took the cloud, closer by."""
        if self._rollout is None:
            return
        observation, more = self._observation(), len(self._panels()) - 1
        self.look_at(
            observation.points.mean(axis=0) + more * _aside(observation) / 2,
            -observation.world_from_camera[:3, 0],
            _size(observation.points) * (1 + 0.6 * more),
        )

    def _simulate(self) -> None:
        if self._rollout is None or self.objects is None:
            return
        require("the simulation of an interaction", "collect", without=("ray",))
        from collector.objects.catalogue import load_ref
        from collector.viz.playback import record

        self.say("simulating ...")
        collection, row = self.store.setting.collection, self.row
        target = load_ref(self.objects, self._rollout.object, collection.collision)
        playback = record(target, collection, self._rollout, row, FRAMES_A_SECOND)
        self._forget_playback()
        self._playback = playback
        fingers = len(playback.hand) - 1
        parts = [PART_COLOURS[k % len(PART_COLOURS)] for k in range(len(target.parts))]
        colours = [BODY_COLOUR, *parts, PALM_COLOUR, *[FINGER_COLOUR] * fingers]
        with self.silently(), self.server.atomic():
            for number, (body, colour) in enumerate(zip(playback.scenery().bodies, colours, strict=True)):
                self._add_mesh(f"/simulation/{number}", body.visuals or body.collisions, colour)
            self.span(self.frame, 0, len(playback.times) - 1, 0)
            self.play.disabled = False
            self.put(self.cloud, False)
        again = playback.outcome
        same = again.kind is row.outcome.kind and again.success is row.outcome.success
        self.simulated.content = small(
            f"{'the same outcome as stored' if same else f'ANOTHER OUTCOME than stored: {again.kind}'}; "
            f"moved {again.motion:.3f}, stored {row.outcome.motion:.3f}"
        )
        self._draw()
        self._pose()
        self.say("")

    def _add_mesh(self, name: str, meshes: "Sequence[Mesh]", colour: tuple[int, int, int]) -> None:
        counts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
        vertices = np.concatenate([np.zeros((0, 3)), *(mesh.vertices for mesh in meshes)])
        faces = [np.zeros((0, 3), np.int64), *(mesh.faces + start for mesh, start in zip(meshes, counts, strict=False))]
        add = self.server.scene.add_mesh_simple
        self._moving.append(add(name, vertices, np.concatenate(faces), color=colour, side="double", flat_shading=True))

    def _pose(self) -> None:
        """Move object and hand to where they are in the frame that is chosen."""
        playback = self._playback
        if playback is None:
            return
        poses = playback.poses(int(self.frame.value))
        with self.server.atomic():
            for handle, pose in zip(self._moving, poses, strict=True):
                handle.position, handle.wxyz = pose[:3, 3], quaternion_from_rotation(pose[:3, :3])

    def _play(self) -> None:
        """Play from the frame that is chosen, or pause; other callbacks go on meanwhile."""
        if self._playing:
            self._playing = False
            return
        playback = self._playback
        if playback is None:
            return
        last = len(playback.times) - 1
        first = int(self.frame.value) if self.frame.value < last else 0
        self._playing, began = True, time.monotonic()
        while self._playing and self._playback is playback:
            frame = min(first + int((time.monotonic() - began) * FRAMES_A_SECOND), last)
            with self.lock:
                if self._playback is playback:
                    self.put(self.frame, frame)
            if frame == last:
                break
            time.sleep(1 / FRAMES_A_SECOND)
        self._playing = False

    def _forget_playback(self) -> None:
        self._playback, self._playing = None, False
        self._moving.clear()
        self.server.scene.remove_by_name("/simulation")
        with self.silently():
            self.span(self.frame, 0, 0, 0)
            self.play.disabled = True
            self.put(self.cloud, True)
        if self.objects is not None:
            self.simulated.content = ""


def _named(match: Match) -> str:
    """A rollout as the list shows it."""
    return plain(f"{match.rollout}: {match.object_id}, {match.successes}/{len(match.steps)} succeed, {match.plan}")


def _step(buttons: Any) -> int:
    return 1 if buttons.value == "next" else -1


def _colour(success: bool) -> tuple[int, int, int]:
    return SUCCESS if success else FAILURE


def _size(points: Any) -> float:
    return float(np.ptp(points, axis=0).max())


def _aside(observation: Observation) -> Float:
    """From a cloud to its copy on the right of it, as the camera sees them."""
    left = observation.world_from_camera[:3, 1]
    shift: Float = -1.25 * max(float(np.ptp(observation.points @ left)), 0.5 * _size(observation.points)) * left
    return shift
