"""`adaafford adapt`: affordance that adapts to a real object, for a robot that reads and writes files."""

import json
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, BinaryIO

import tyro
from pydantic import Field

from adaafford.recordings import WHOLE, Selection
from cluster.config.flags import OutFile, parse_flags
from shared.errors import AdaAffordError, UsageError
from shared.io.text import plain
from shared.types import OutcomeKind

if TYPE_CHECKING:
    from adaafford.sessions import Session

MAX_LINE_BYTES = 1 << 16
MAX_BASE = 100.0
"""m or rad."""
MIN_SHOWN, MAX_SHOWN = 64, 16384
"""Of a scan's points, as in the configuration of the simulated camera."""


@dataclass(frozen=True, slots=True)
class AdaptCommand:
    """Propose the next interaction with a scanned object, and predict where it can be moved, given its history.

    Prints one JSON object: what to do ("try" or "act"), and point, approach and forward direction in the scan's frame.
    Give its outcome by --outcome, with the next scan, or write it into the history. docs/robot.md describes the frames
    and the history's schema.
    """

    cloud: Path
    """A scan of the object in its present state (.ply, .npz or .pcd): metres, only the object unless --part is given.
    Or a depth image (.png of 16 bits in mm; .npy, or .npz with `depth`, in metres) with --intrinsics. Or a recording of
    ROS 2 (.mcap, .db3 or the folder), whose last scan is taken."""
    history: Path
    """The interactions so far (JSON), created if missing. Scans are in the same folder or below."""
    policy: str | None = None
    """The name of a bundled policy, a folder with weights.safetensors and policy.json, or a finished run. Without
    it, the bundled ones are listed."""
    out: OutFile | None = None
    """File for the adapted affordance: .ply, .npz or .html; default: heatmap.ply beside the history."""
    part: str | None = None
    """Of raw scans, with the object's surroundings: the part to act on: auto (the most confident), the number of one
    that an answer names, or a point on it as X,Y,Z. It is followed in later scans. Default: the history's; without
    one, a scan is of the object alone."""
    outcome: float | None = None
    """How far the part moved in the interaction of the last call: rad if it turns, m if it slides, 0 for no motion."""
    kind: OutcomeKind = OutcomeKind.UNKNOWN
    """How that interaction ended, such as "ok", "no-contact" or "no-grasp"."""
    grasp_width: float | None = None
    """Opening of the two fingers together after they closed in that interaction, m; of a suction cup its diameter if it
    sealed, else 0."""
    interaction: int | None = None
    """Number of the interaction that --outcome is of, as an answer names it: a call that is repeated counts it once."""
    success: bool | None = None
    """Whether the part moved as intended; default: whether it moved by more than 0.01."""
    up: tuple[float, float, float] | None = None
    """The direction against gravity in the scan's frame; default: that of the history or the scan, otherwise 0 0 1. A
    level camera with x right, y down and z forward has 0 -1 0."""
    camera: tuple[float, float, float] | None = None
    """The camera position in the scan's frame; default: that of the history or the scan, otherwise 0 0 0."""
    intrinsics: tuple[float, float, float, float] | None = None
    """Of the camera of depth images: FX FY CX CY, pixels; default: the history's."""
    pose: tuple[float, float, float, float, float, float, float] | None = None
    """Where that camera stands: x y z in metres and its rotation as a quaternion x y z w, in the frame of the answers.
    Default: answers are in its own frame (x right, y down, z forward), and up is 0 -1 0."""
    recorded: Annotated[Selection, tyro.conf.arg(name="")] = WHOLE
    budget: int = 4
    """The most interactions that are proposed before the final action."""
    proposer: str = "aip-spread"
    """What chooses these interactions: aip-spread, AIP in the half of the points furthest from the earlier ones; aip,
    as published; information-gain, which takes half a second a step; or another proposer, such as fps."""
    points: int = 2048
    """How many points of a scan the policy receives: as many as in its training (see its model card)."""
    seed: Annotated[int, Field(ge=0)] = 0
    """Of the random draws."""
    arm: str | None = None
    """The arm that executes the actions: panda, ur5e, FILE.urdf, or FILE.urdf#LINK where LINK carries the hand. Only
    what it reaches is proposed, with the joint trajectory; the heatmap shows in grey what it does not reach."""
    base: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    """With --arm: X Y Z YAW of its base in the scan's frame: m, and rad about --up from x."""
    follow: bool = False
    """Keep running: for each line {"cloud": "scan-2.ply", "outcome": {"motion": 0.2}} on standard input, print the next
    step. A step then takes a fraction of a second, because the policy stays loaded."""


def main(args: list[str]) -> int:
    """Adapt."""
    command = parse_flags(AdaptCommand, args, "adapt")
    details = (command.success, command.grasp_width, None if command.kind is OutcomeKind.UNKNOWN else command.kind)
    if command.outcome is None and any(detail is not None for detail in details):
        raise UsageError(
            "--success, --kind and --grasp-width say how an outcome is meant; give --outcome MOTION with them"
        )
    if command.interaction is not None and (command.outcome is None or command.interaction < 1):
        raise UsageError(
            f"--interaction {command.interaction}: the number, from 1, of the interaction that --outcome is of"
        )
    if command.budget < 1:
        raise UsageError(f"--budget {command.budget}: at least one interaction is needed to adapt")
    if not MIN_SHOWN <= command.points <= MAX_SHOWN:
        raise UsageError(f"--points {command.points}: allowed are {MIN_SHOWN} to {MAX_SHOWN}")
    if command.arm is None and any(command.base):
        raise UsageError("--base says where the base of --arm stands; name the arm")
    if not all(abs(number) <= MAX_BASE for number in command.base):
        raise UsageError(f"--base {command.base}: X Y Z YAW are finite numbers, at most {MAX_BASE:g}: m and rad")
    from adaafford.depth_images import Lens
    from adaafford.histories import TriedOutcome
    from adaafford.pretrained import load_policy, only_pretrained
    from adaafford.sessions import Session, SessionFiles
    from shared.arms.arm import arm_of
    from shared.config import parse

    files = SessionFiles(command.history, command.out or command.history.parent / "heatmap.ply")
    policy = load_policy(command.policy or only_pretrained())
    if command.pose is not None and command.intrinsics is None:
        raise UsageError("--pose: says where the camera of a depth image stands; give its --intrinsics with it")
    lens = None
    if command.intrinsics is not None:
        lens = parse(Lens, {"intrinsics": command.intrinsics, "pose": command.pose}, "--intrinsics and --pose")
    session = Session(
        policy,
        files,
        command.budget,
        command.seed,
        command.up,
        command.camera,
        command.points,
        tell=_say,
        arm=None if command.arm is None else arm_of(command.arm),
        base=command.base,
        part=command.part,
        lens=lens,
        selection=command.recorded,
        proposer=command.proposer,
    )
    told = {
        "motion": command.outcome,
        "success": command.success,
        "kind": command.kind,
        "grasp_width": command.grasp_width,
    }
    outcome = None if command.outcome is None else parse(TriedOutcome, told, "--outcome")
    print(session.step(command.cloud, outcome, command.interaction).model_dump_json(), flush=True)
    if command.follow:
        _follow(session, command.cloud.parent)
    return 0


def lines_of(stream: BinaryIO) -> Iterator[bytes]:
    """Lines as they come; of one that is too long only the first `MAX_LINE_BYTES` are kept."""
    while line := stream.readline(MAX_LINE_BYTES):
        rest = line
        while len(rest) == MAX_LINE_BYTES and not rest.endswith(b"\n"):
            rest = stream.readline(MAX_LINE_BYTES)
        yield line


def answer_lines(advice: str, answer: Callable[[bytes], str]) -> None:
    """Answer each line of the standard input by a line; one that cannot be answered, by its reason.

    Args:
        advice: end of the message about a line that is too long: what to write instead.
        answer: makes the line of the answer; what it raises of our own errors is the reason.
    """
    for line in lines_of(sys.stdin.buffer):
        try:
            if len(line) >= MAX_LINE_BYTES:
                raise UsageError(f"a line of more than {MAX_LINE_BYTES} bytes; {advice}")
            print(answer(line), flush=True)
        except AdaAffordError as error:
            print(json.dumps({"error": str(error)}), flush=True)


def _say(line: str) -> None:
    print(f"adaafford: {plain(line)}", file=sys.stderr, flush=True)


def _follow(session: "Session", folder: Path) -> None:
    """Go on with the session, line by line."""
    from adaafford.sessions import Request

    def answer(line: bytes) -> str:
        request = Request.read(line)
        if request.health:
            return session.health.model_dump_json()
        return session.step(folder / request.cloud, request.outcome, request.interaction, request.at).model_dump_json()

    answer_lines('write {"cloud": "scan.ply"}', answer)
