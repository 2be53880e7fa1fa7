"""A rehearsal: a simulated object in place of a robot, behind the protocol of `adaafford adapt --follow`.

The robot's side of the protocol reads the answers of a session (`Step`) and gives scans and outcomes (`Request`). Here
the scans are rendered with the errors of a depth camera, and the actions executed in the simulator. The state is in a
file beside the scans, which is written after each interaction, so a rehearsal can be ended at any moment.
An answer that comes a second time is not executed again.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import Field

from adaafford.histories import TriedOutcome, parse_json
from adaafford.parts import PartError
from adaafford.scans import Scan, ScanFrame, action_at, npz_of
from adaafford.sessions import ReachError, Request, Session, Step
from collector.objects.articulation import Body
from collector.scenes import draw_surroundings, extent, raw_scan
from collector.sim.armed import ArmedEnvironment
from collector.sim.camera import noisy
from collector.sim.environment import camera_for
from collector.sim.simulator import SimEnvironment
from shared import seeds
from shared.config import CameraConfig, StrictModel
from shared.errors import UsageError
from shared.io.files import read_bounded, write_atomically
from shared.types import Outcome, OutcomeKind

STATE = "rehearsal.json"
MAX_STATE_BYTES = 1 << 20
BASE = (1.2, 0.0, 0.6)
"""Where the object's origin is in the frame of the scans without an arm, m; z is up, and the object faces -x."""
PURPOSE, SURROUNDINGS_PURPOSE = "depth noise", "surroundings"


class Setting(StrictModel):
    """What defines a rehearsal.

    Attributes:
        task: name or definition.
        object: id.
        seed: everything random derives from it.
        number: which of the objects that this seed gives, from 0.
        noise: see `collector.sim.camera.noisy`.
        marked: whether scans say which points the policy may act on.
        arm: name or file of the arm; None: the hand flies.
        scene: whether scans are raw: with a floor, perhaps walls and other things, and nothing marked.
    """

    task: str
    object: str
    seed: int
    number: int
    noise: float
    marked: bool
    arm: str | None = Field(None, exclude_if=lambda arm: arm is None)
    scene: bool = False


class Executed(StrictModel):
    """One interaction that was executed.

    Attributes:
        step: the answer that asked for it.
        outcome: of it.
        joint_positions: [parts], after it, at rest.
    """

    step: Step
    outcome: TriedOutcome
    joint_positions: tuple[float, ...]


class State(StrictModel):
    """The file `rehearsal.json`."""

    format: Literal["adaafford-rehearsal"] = "adaafford-rehearsal"
    schema_version: Literal[1] = 1
    setting: Setting
    start: tuple[float, ...]
    """[parts], the joint positions before the first interaction."""
    executed: tuple[Executed, ...] = Field((), max_length=64)


class SimulatedRobot:
    """A camera and a hand in front of one simulated object.

    Args:
        environment: at rest, with the object in view; the same for the same setting.
        again: makes it anew. Each interaction is in an environment in which none was before, as after an interruption:
            a state that is restored does not remove all that the engine keeps of earlier interactions.
        setting: of the rehearsal.
        folder: for scans and state; what is there already is continued.

    Attributes:
        folder: the same.
        base: x, y, z and yaw of the arm's base in the frame of the scans; None: the hand flies.

    Raises:
        UsageError: the folder has the state of another rehearsal, or a file that is none.
    """

    def __init__(
        self, environment: SimEnvironment, again: Callable[[], SimEnvironment], setting: Setting, folder: Path
    ) -> None:
        self._environment, self._again, self.folder = environment, again, folder
        self._used = False
        self._config = CameraConfig()
        self.base: tuple[float, float, float, float] | None = None
        self._origin = BASE
        if isinstance(environment, ArmedEnvironment):
            x, y, z, yaw = environment.base
            self._origin, self.base = (-x, -y, -z), (0.0, 0.0, 0.0, yaw)
        observed = environment.observe()
        self._pose = observed.world_from_camera
        self._parts = np.unique(observed.part_ids[observed.movable])
        path = folder / STATE
        if path.exists():
            self._state = parse_json(State, read_bounded(path, MAX_STATE_BYTES), f"{path}: ", "name another folder")
            if self._state.setting != setting:
                raise UsageError(f"{path}: is of another rehearsal; give the same settings, or another folder")
        else:
            self._state = State(setting=setting, start=tuple(environment.state().tolist()))
        self._restore()
        # Of a rehearsal that was ended before its first state was written, the first scan may be missing.
        if not self._scan_path(len(self.executed)).exists() or not path.exists():
            self._write_scan(len(self.executed))
            self._write_state()

    @property
    def executed(self) -> tuple[Executed, ...]:
        """The interactions that were executed, in order."""
        return self._state.executed

    @property
    def moved(self) -> float:
        """How far the joint of the part that is to be moved is from where it was at first, rad or m."""
        joint = int(self._parts[0]) - 1
        now = self.executed[-1].joint_positions if self.executed else self._state.start
        return abs(now[joint] - self._state.start[joint])

    @property
    def request(self) -> Request:
        """The scan of the object in its present state, and the outcome of the last interaction."""
        done = len(self.executed)
        if done == 0:
            return Request(cloud=self._scan_path(0).name)
        return Request(cloud=self._scan_path(done).name, outcome=self.executed[-1].outcome, interaction=done)

    def execute(self, step: Step) -> Request:
        """Execute the action of an answer, and look at the object again.

        Raises:
            UsageError: the answer is not the next one, or differs from the one that was executed under its number.
        """
        done = len(self.executed)
        if done and step.interaction == done and _action_of(step) == _action_of(self.executed[-1].step):
            return self.request  # The answer came a second time.
        if step.interaction != done + 1:
            raise UsageError(f"interaction {step.interaction} cannot follow {done} executed ones")
        outcome = self._try(step)
        self._environment.observe()  # Waits until the object is at rest.
        after = tuple(self._environment.state().tolist())
        executed = Executed(step=step, outcome=outcome, joint_positions=after)
        self._write_scan(done + 1)
        self._state = self._state.model_copy(update={"executed": (*self.executed, executed)})
        self._write_state()
        return self.request

    def _try(self, step: Step) -> TriedOutcome:
        """Execute an action that was chosen on a noisy scan, on the part of the nearest point that is seen."""
        if self._used:
            self._environment = self._again()
            self._restore()
        self._used = True
        observed = self._environment.observe()
        frame = ScanFrame(camera=(0.0, 0.0, 0.0), origin=self._origin)
        try:
            action = action_at(observed, frame, step.point, step.approach, step.forward)
            # The nearest kept point says which part it is. It may be a centimetre away; the hand goes where it is told.
            action = replace(action, point=frame.to_world(step.point))
        except UsageError:
            return TriedOutcome(motion=0.0, success=False, kind=OutcomeKind.NO_CONTACT)  # It points into the air.
        return _told(self._environment.execute(action))

    def _restore(self) -> None:
        states = [self._state.start, *(done.joint_positions for done in self.executed)]
        if any(len(state) != len(self._environment.state()) for state in states):
            raise UsageError(f"{self.folder / STATE}: is of another object; name another folder")
        self._environment.observe()
        for state in states[1:]:
            # Each look draws other points of what is seen, so the earlier ones are repeated.
            self._environment.restore(np.array(state))
            self._environment.observe()

    def _scan_path(self, number: int) -> Path:
        return self.folder / f"scan-{number + 1}.npz"

    def _write_scan(self, number: int) -> None:
        setting, target, state = self._state.setting, self._environment.object, self._environment.state()
        rng, place = seeds.generator(setting.seed, PURPOSE, number), self._pose[:3, 3]
        if setting.scene:
            image = raw_scan(target, state, self._pose, self._surroundings(), setting.noise, rng).image
        else:
            camera = camera_for(target, self._pose, self._config)
            image = noisy(camera.capture(state), self._config.image_size, place, setting.noise, rng)
        x, y, z = (place + self._origin).tolist()
        scan = Scan(
            (image.points + self._origin).astype(np.float32).astype(np.float64),
            movable=np.isin(image.bodies, self._parts) if setting.marked else None,
            camera=(x, y, z),
        )
        write_atomically(self._scan_path(number), npz_of(scan))

    def _surroundings(self) -> Body:
        """What stands around the object, out of the way of its parts; the same in all scans."""
        setting, target = self._state.setting, self._environment.object
        limits = target.limits()
        states = np.stack([limits[:, 0], limits.mean(axis=1), limits[:, 1], np.array(self._state.start)])
        rng = seeds.generator(setting.seed, SURROUNDINGS_PURPOSE, setting.number)
        return draw_surroundings(*extent(target, states), self._pose[:3, 3], rng)

    def _write_state(self) -> None:
        write_atomically(self.folder / STATE, self._state.model_dump_json(indent=2).encode() + b"\n")


@dataclass(frozen=True, slots=True)
class Goal:
    """How far a part is to be moved.

    Attributes:
        motion: of its joint, either way from where it was at first, rad or m.
        within: the most interactions.
        repeat: whether the first final action is executed again and again, instead of one that is proposed each time.
    """

    motion: float
    within: int
    repeat: bool = False


def rehearse(
    robot: SimulatedRobot, session: Session, tell: Callable[[Step, Request], None], goal: Goal | None = None
) -> bool:
    """Let a session act on a simulated robot until its final action was executed, or a goal was reached.

    Args:
        robot: with the object.
        session: with the policy.
        tell: receives each answer and what came of it.
        goal: what is to be reached by several final actions.

    Returns:
        Whether the final action succeeded, or the goal was reached; the history has all outcomes.
    """
    while True:
        request, executed = robot.request, robot.executed
        acts = [one.step for one in executed if one.step.do == "act"]
        try:
            step = session.step(robot.folder / request.cloud, request.outcome, request.interaction)
        except (PartError, ReachError):
            if goal is None and acts:
                break  # The final action was executed; only another one would need the part, or be out of reach.
            raise
        if goal is None and acts:
            break
        if goal is not None and (robot.moved >= goal.motion or len(executed) >= goal.within):
            return robot.moved >= goal.motion
        if goal is not None and goal.repeat and acts:
            step = acts[0].model_copy(update={"interaction": step.interaction, "tries": step.tries})
        tell(step, robot.execute(step))
    return bool(robot.executed[-1].outcome.success)


def _action_of(step: Step) -> tuple[object, ...]:
    return step.point, step.approach, step.forward


def _told(outcome: Outcome) -> TriedOutcome:
    """An outcome as a robot says it."""
    return TriedOutcome(
        motion=round(min(outcome.motion, 100.0), 6) if np.isfinite(outcome.motion) else 0.0,
        success=outcome.success,
        kind=outcome.kind,
        grasp_width=round(outcome.grasp_opening, 6) if np.isfinite(outcome.grasp_opening) else None,
    )
