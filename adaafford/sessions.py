"""A session: the test-time loop over files, for a robot whose program runs in another process.

Each step reads a scan and the outcome of the last proposal, if it was executed. It writes the next proposal to the
history and the adapted affordance to a heatmap. A session can be ended and continued from its history.
"""

import hashlib
import os
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import Field, model_validator

from adaafford.depth_images import Lens, parse_depth
from adaafford.heatmaps import heatmap_writer, write_heatmap
from adaafford.histories import History, ScanName, TriedOutcome, parse_json, read_history, scan_name, write_history
from adaafford.parts import PARTS_SUFFIX, CutOut, FollowedPart, PartAnswer, PartFinder, part_choice
from adaafford.recordings import MAX_AT, WHOLE, Selection, is_recording, take_scan
from adaafford.scans import (
    DEFAULT_UP,
    POINTS,
    Scan,
    ScanFrame,
    Vector,
    doubtful_up,
    missing_points,
    observation_of,
    parse_scan,
    read_scan_file,
)
from shared import seeds
from shared.arms.arm import Arm
from shared.arms.kinematics import ArmReach, reachable_points
from shared.config import Name, StrictModel
from shared.errors import UsageError
from shared.io.files import create_exclusively, writing
from shared.io.text import plain
from shared.policies.adaptation import Adapter
from shared.policies.methods import PROPOSERS
from shared.policies.policy import Policy
from shared.policies.proposers import RepeatProposer, SpreadAipProposer, proposer_named
from shared.primitives import PRIMITIVES
from shared.types import Action, Observation

PURPOSE = "adapt"
FINAL_SHARE = 0.01
"""Of the cloud's points: where no try succeeded, the final action is at one of the best, as in the published code. In
rehearsals with real objects 45% of final actions moved a closed door, and 30% with one of the best 100; faucets 85% and
50%."""
SURFACE_POINTS = 10_000
"""Of a scan, about, that the links of an arm must not touch."""


class ReachError(UsageError):
    """The arm reaches none of the actions that are proposed for a scan."""


@dataclass(frozen=True, slots=True)
class SessionFiles:
    """What a session reads and writes.

    Attributes:
        history: the history, created if missing; clouds are in its folder or below.
        heatmap: the file for the adapted affordance (see `adaafford.heatmaps`); None: none is written. Of raw scans,
            the parts are written to a second file beside it.
    """

    history: Path
    heatmap: Path | None


@dataclass(frozen=True, slots=True)
class _Seen:
    """What is seen in a scan.

    Attributes:
        observation: of it.
        sha256: of its file.
        cut: of a raw scan: its parts.
    """

    observation: Observation
    sha256: str
    cut: CutOut | None


class Seconds(StrictModel):
    """Duration of the parts of a step, s."""

    read: float
    """The scans and the history."""
    propose: float
    """Adaptation and the choice of the action."""
    write: float
    """The heatmap and the history."""


class Trajectory(StrictModel):
    """What an arm's controller executes: the whole primitive, from the start pose of the hand on."""

    joints: tuple[str, ...]
    """Their names."""
    waypoints: tuple[tuple[float, ...], ...]
    """[W, J], rad or m; straight in between, at most 2 cm of the hand apart."""


class Step(StrictModel):
    """The answer of a session, in the frame of the scan."""

    do: Literal["try", "act"]
    """"try": a proposal of AIP, to learn more about the object; "act": the action that should succeed."""
    tries: int
    """Number of interactions with an outcome in the history."""
    interaction: int = Field(ge=1)
    """Number of the proposed interaction in the history, from 1. Give it back with its outcome, which is then counted
    once, however often it is given."""
    point: Vector
    approach: Vector
    forward: Vector
    belief: float
    """The predicted success probability of the action."""
    trajectory: Trajectory | None = Field(None, exclude_if=lambda trajectory: trajectory is None)
    """Of the arm, if one was named."""
    seconds: float
    """Duration of the step."""
    part: PartAnswer | None = Field(None, exclude_if=lambda answer: answer is None)
    """Of a raw scan: the part that the action is on, and the others that were found."""


class Health(StrictModel):
    """What a session with `--follow` says of itself."""

    health: Literal["ok"] = "ok"
    steps: int
    """Answered since the session was started."""
    tries: int
    """Number of interactions with an outcome, at the last step."""
    last: Seconds | None
    """Duration of the parts of the last step; None before the first."""


class Request(StrictModel):
    """One input line of a session with `--follow`: a scan, or a question after its health."""

    cloud: ScanName = ""
    """A scan of the object in its present state."""
    outcome: TriedOutcome | None = None
    """The outcome of the last proposal; None if it was not executed."""
    interaction: int | None = Field(None, ge=1)
    """Number of the interaction that the outcome is of; None: the last proposal."""
    at: float | None = Field(None, ge=0, le=MAX_AT)
    """Of a recording: seconds after its beginning; None: as --at says."""
    health: bool = False
    """Whether the line asks for `Health` alone."""

    @model_validator(mode="after")
    def _asks_for_one_thing(self) -> "Request":
        if self.health is bool(self.cloud):
            raise ValueError("needs a cloud, or health alone")
        if self.interaction is not None and self.outcome is None:
            raise ValueError("an interaction's number says what an outcome is of; give the outcome with it")
        return self

    @classmethod
    def read(cls, line: bytes) -> "Request":
        """Parse an untrusted line.

        Raises:
            UsageError: it is not a request.
        """
        return parse_json(cls, line, "", 'write {"cloud": "scan.ply"}')


class Session:
    """One object, from its first scan to the last.

    Args:
        policy: with prior and AAP trained, and what the proposer needs.
        files: what is read and written.
        budget: how many interactions the proposer may propose.
        seed: of the random draws; a repeated step gives the same answer.
        up: direction against gravity, in the frame of the scans; default: the history's, otherwise 0 0 1.
        camera: camera position, in the same frame; default: that of the first scan, otherwise 0 0 0.
        points: how many points of a scan the policy receives.
        tell: receives warnings about a scan or its frame.
        arm: that executes the actions; only what it reaches is proposed. None: anything is.
        base: x, y, z and yaw of its base, in the frame of the scans: m, and rad about `up` from x (from y where up is
            x). The floor is as low as the base, or as the lowest point of the scan.
        part: which part of raw scans is acted on (see `PartChoice.of`); default: the history's, and without one, scans
            are of the object alone.
        lens: of the camera, if scans are depth images; default: the history's.
        selection: which scans of recordings are taken.
        proposer: that chooses the interactions, by name.
    """

    def __init__(
        self,
        policy: Policy,
        files: SessionFiles,
        budget: int = 4,
        seed: int = 0,
        up: Vector | None = None,
        camera: Vector | None = None,
        points: int = POINTS,
        tell: Callable[[str], object] = lambda line: None,
        arm: Arm | None = None,
        base: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0),
        part: str | None = None,
        lens: Lens | None = None,
        selection: Selection = WHOLE,
        proposer: Name = SpreadAipProposer.name,
    ) -> None:
        policy.require("prior", "aap", *PROPOSERS.get(proposer).modules)
        self._choice = None if part is None else part_choice(part)
        self._task = policy.task_record
        if files.heatmap is not None:
            heatmap_writer(files.heatmap)
        self._adapter = Adapter(policy)
        self._files, self._budget, self._seed, self._points = files, budget, seed, points
        self._up, self._camera, self._lens, self._tell = up, camera, lens, tell
        self._arm, self._base, self._selection, self._proposer = arm, base, selection, proposer
        primitive = None if self._task is None else self._task.primitive
        self._primitive = PRIMITIVES.get(primitive) if primitive in PRIMITIVES.names() else None
        if arm is not None and self._primitive is None:
            raise UsageError(
                f"--arm: how the hand moves in the policy's task '{policy.task}' is not known here; install the "
                "package that adds it, or train the policy again if a file defined the task"
            )
        self._seen: dict[tuple[str, ScanFrame, FollowedPart | None, tuple[Vector, ...]], _Seen] = {}
        self._steps = self._tries = 0
        self._seconds: Seconds | None = None

    @property
    def health(self) -> Health:
        """That the session lives, and how long its last step took."""
        return Health(steps=self._steps, tries=self._tries, last=self._seconds)

    def step(
        self,
        cloud: Path,
        outcome: TriedOutcome | None = None,
        interaction: int | None = None,
        at: float | None = None,
    ) -> Step:
        """Read a scan and the last outcome, and propose the next action.

        A step that is repeated gives the same answer, and its outcome is counted once.

        Args:
            cloud: a scan of the object in its present state.
            outcome: of the last proposal; None if it was not executed.
            interaction: number of the interaction that the outcome is of (`Step.interaction`); None: the last proposal,
                unless the same outcome was told with the same scan before.
            at: of a recording: seconds after its beginning; None: as the session's selection says.

        Raises:
            UsageError: a file cannot be used, with the reason.
        """
        begun = time.perf_counter()
        if is_recording(cloud):
            cloud = self._taken_out(cloud, at)
        elif at is not None or self._selection != WHOLE:
            raise UsageError(f"{cloud}: is no recording; leave out --topic, --at and --frame")
        name = self._name_of(cloud)
        history = self._history(name)
        if outcome is not None and not self._is_told(history, outcome, interaction, name):
            history = history.concluding(outcome)
        used: list[_Seen] = []

        def observe(cloud: str, wanted: str | None, followed: FollowedPart | None) -> Observation:
            before = used[-1].cut if used else None
            used.append(self._observe(cloud, wanted, history, followed, before, self._unmoved(history, len(used))))
            return used[-1].observation

        known = history.interactions_with(lambda each: observe(each.cloud, each.cloud_sha256, each.part))
        observation = observe(name, None, history.interactions[-1].part if history.interactions else None)
        now, told = used[-1], {id(each) for each in used}
        self._seen = {key: value for key, value in self._seen.items() if id(value) in told}
        read = time.perf_counter()
        rng = seeds.generator(self._seed, PURPOSE, len(known))
        action = None
        if len(known) < self._budget:
            action = proposer_named(self._proposer, self._adapter, rng, self._budget).propose(observation, known)
        do: Literal["try", "act"] = "act" if action is None else "try"
        if action is None:
            action = RepeatProposer(self._adapter, rng, share=FINAL_SHARE).propose(observation, known)
            assert action is not None, "an exploiter never stops"
        trajectory = self._trajectory(observation, action, cloud)
        belief = float(self._adapter.score(observation, [action], known)[0])
        heat = None if self._files.heatmap is None else self._adapter.affordance(observation, known)
        chosen = time.perf_counter()
        if self._files.heatmap is not None and heat is not None:
            places = history.frame.point_to_scan(observation.points.astype(np.float64))
            reachable = None if observation.reach is None else reachable_points(observation)
            write_heatmap(self._files.heatmap, places, heat, observation.pixels, reachable)
            if now.cut is not None:
                write_heatmap(parts_file(self._files.heatmap), *now.cut.picture())
        answer = None if now.cut is None else now.cut.answer
        history = history.proposing(action, name, now.sha256, None if answer is None else answer.followed)
        write_history(self._files.history, history)
        proposed, ended = history.interactions[-1], time.perf_counter()
        self._steps, self._tries = self._steps + 1, len(known)
        self._seconds = Seconds(
            read=round(read - begun, 3), propose=round(chosen - read, 3), write=round(ended - chosen, 3)
        )
        return Step(
            do=do,
            tries=len(known),
            interaction=len(known) + 1,
            point=proposed.point,
            approach=proposed.approach,
            forward=proposed.forward,
            belief=round(belief, 4),
            trajectory=trajectory,
            seconds=round(ended - begun, 3),
            part=answer,
        )

    def _trajectory(self, observation: Observation, action: Action, cloud: Path) -> Trajectory | None:
        """How the arm executes an action.

        Raises:
            ReachError: it reaches neither this nor any other action that was looked at.
        """
        if self._arm is None or observation.reach is None:
            return None
        path = observation.reach.trajectory(action)
        if path is None:
            base = " ".join(f"{number:g}" for number in self._base)
            raise ReachError(
                f"{cloud}: the arm with its base at {base} reaches none of the actions that the policy proposes; move "
                "the base or the object, or correct --base"
            )
        return Trajectory(
            joints=tuple(joint.name for joint in self._arm.joints),
            waypoints=tuple(map(tuple, path.round(5).clip(*self._arm.limits).tolist())),
        )

    def _is_told(self, history: History, outcome: TriedOutcome, interaction: int | None, cloud: str) -> bool:
        """Whether a history holds an outcome already, because the step is repeated."""
        tried = history.tried
        if interaction is None:
            # The proposal after a step was made with the scan of that step.
            pending = history.pending
            return bool(tried) and pending is not None and pending.cloud == cloud and tried[-1].outcome == outcome
        if interaction > len(tried):
            if interaction > len(history.interactions):
                raise UsageError(
                    f"interaction {interaction} was not proposed; the history holds {len(history.interactions)}"
                )
            return False
        if (told := tried[interaction - 1].outcome) != outcome:
            assert told is not None, "an interaction has an outcome"
            raise UsageError(
                f"interaction {interaction} has an outcome already, motion {told.motion:g}, kind {told.kind.value}; "
                "give that one again, or correct the history"
            )
        return True

    def _history(self, name: str) -> History:
        """The history that is there, or a new one around a first scan."""
        if os.path.exists(self._files.history):  # noqa: PTH110 - pathlib raises where a name is too long.
            history = read_history(self._files.history)
            for setting, given in (("up", self._up), ("camera", self._camera)):
                kept = getattr(history.frame, setting)
                if given is not None and given != kept:
                    raise UsageError(
                        f"{self._files.history}: was begun with {setting} {kept}, now {given}; give the same"
                    )
            if self._lens not in (None, history.lens):
                raise UsageError(f"{self._files.history}: was begun with another camera; give the same intrinsics")
            return self._about_the_part(history)
        if not self._files.history.parent.is_dir():
            raise UsageError(
                f"{self._files.history.parent}: there is no such folder; create it, and put the clouds there"
            )
        path, data, sha256 = self._file(name)
        scan = self._parsed(data, path, self._choice, self._lens)
        up = self._up or scan.up or DEFAULT_UP
        cut = None
        if self._choice is not None:
            camera = self._camera or scan.camera or (0.0, 0.0, 0.0)
            cut = self._finder.cut_out(scan, up, camera, self._choice, None, str(path))
        frame = ScanFrame.around(scan if cut is None else cut.scan, up, self._camera)
        if self._up is None and (doubt := doubtful_up(scan, frame)):
            self._tell(f"{path}: {doubt}; if so, say it by --up and begin another history")
        self._remember(scan, cut, path, sha256, frame, None, ())
        return History(frame=frame, part=self._choice, lens=self._lens)

    @cached_property
    def _finder(self) -> PartFinder:
        """What finds the parts of raw scans; its network is read when the first of these comes."""
        return PartFinder(self._task)

    def _about_the_part(self, history: History) -> History:
        """A history that is there, with the choice of the part that was given now, if nothing was tried before."""
        if self._choice is None or self._choice == history.part:
            return history
        if history.part is None or history.tried:
            which = "without a part" if history.part is None else f"with another part, {history.part}"
            raise UsageError(
                f"{self._files.history}: was begun {which}; leave --part as it was, or begin another history"
            )
        return history.model_copy(update={"part": self._choice, "interactions": ()})

    def _taken_out(self, recording: Path, at: float | None) -> Path:
        """A scan of a recording, as a file beside the history; the same scan always has the same name."""
        if self._lens is not None:
            raise UsageError(f"{recording}: has the intrinsics of its cameras; leave out --intrinsics and --pose")
        selection = self._selection if at is None else self._selection.model_copy(update={"at": at})
        data, line = take_scan(recording, selection)
        cloud = self._files.history.parent / f"{recording.stem}-{hashlib.sha256(data).hexdigest()[:12]}.npz"
        with writing(cloud, "put the history elsewhere"):
            if create_exclusively(cloud, data):
                self._tell(f"{recording}: {line}, was written to {cloud}")
        return cloud

    def _name_of(self, cloud: Path) -> str:
        """How a history in its folder names the cloud."""
        folder = os.path.realpath(self._files.history.parent)
        try:
            # Of a loop of links pathlib would raise; reading refuses it.
            name = Path(os.path.realpath(cloud)).relative_to(folder).as_posix()
        except ValueError:
            raise UsageError(
                f"{cloud}: is not in the folder of the history or below; put it into {folder} to keep both together"
            ) from None
        try:
            return scan_name(name)
        except ValueError as error:
            raise UsageError(f"{plain(name)}: {error}; rename the scan") from None

    def _unmoved(self, history: History, count: int) -> tuple[Vector, ...]:
        """The points that were pulled in vain by the first `count` interactions."""
        if history.part is None or self._primitive is None or not self._primitive.closes_fingers:
            return ()
        tried = ((each.point, each.outcome) for each in history.tried[:count])
        return tuple(point for point, outcome in tried if outcome is not None and outcome.held_still)

    def _observe(
        self,
        name: str,
        wanted: str | None,
        history: History,
        followed: FollowedPart | None,
        before: CutOut | None,
        unmoved: tuple[Vector, ...],
    ) -> "_Seen":
        """What is seen in a cloud's file, after what was seen `before`.

        It is made once for the same content, since the networks' work on it is remembered with it.
        """
        path, data, sha256 = self._file(name)
        if wanted not in (None, sha256):
            raise UsageError(f"{path}: was overwritten after its interaction; use a new file name for every scan")
        frame = history.frame
        if (sha256, frame, followed, unmoved) not in self._seen:
            scan, cut = self._parsed(data, path, history.part, history.lens), None
            if history.part is not None:
                cut = self._finder.cut_out(
                    scan, frame.up, frame.camera, history.part, followed, str(path), before, unmoved
                )
            self._remember(scan, cut, path, sha256, frame, followed, unmoved)
        return self._seen[sha256, frame, followed, unmoved]

    def _file(self, name: str) -> tuple[Path, bytes, str]:
        """A cloud's path, bytes and hash."""
        path = self._files.history.parent / name
        data = read_scan_file(path)
        return path, data, hashlib.sha256(data).hexdigest()

    def _parsed(self, data: bytes, path: Path, choice: str | None, lens: Lens | None) -> Scan:
        raw = choice is not None
        return parse_scan(data, path, raw=raw) if lens is None else parse_depth(data, path, lens, raw=raw)

    def _remember(
        self,
        scan: Scan,
        cut: CutOut | None,
        path: Path,
        sha256: str,
        frame: ScanFrame,
        followed: FollowedPart | None,
        unmoved: tuple[Vector, ...],
    ) -> None:
        if missing := missing_points(scan):
            self._tell(f"{path}: {missing}")
        scan = scan if cut is None else cut.scan
        observed = observation_of(scan, frame, self._seed, self._points)
        if self._arm is not None and self._primitive is not None:
            x, y, z = frame.to_world([self._base[:3]])[0]
            surface = frame.to_world(scan.points[:: 1 + len(scan.points) // SURFACE_POINTS])
            observed = replace(observed, reach=ArmReach(self._arm, (x, y, z, self._base[3]), self._primitive, surface))
        seen = self._seen[sha256, frame, followed, unmoved] = _Seen(observed, sha256, cut)
        if cut is not None:
            # So the history names the part from now on.
            self._seen[sha256, frame, cut.answer.followed, unmoved] = seen


def parts_file(heatmap: Path) -> Path:
    """The file for the parts of a raw scan, beside that of its heatmap."""
    return heatmap.with_name(f"{heatmap.stem}{PARTS_SUFFIX}{heatmap.suffix}")
