"""`adaafford rehearse`: a simulated robot behind the protocol of `adaafford adapt --follow`."""

import sys
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro
from pydantic import Field

from cluster.config.flags import OutFolder, parse_flags
from shared.config import MAX_NOISE, PANDA
from shared.errors import UsageError
from shared.extras import require
from shared.io.files import make_folder
from shared.io.text import plain

if TYPE_CHECKING:
    from adaafford.sessions import Request, Step
    from cluster.evaluation.rehearsal import SimulatedRobot
    from shared.policies.policy import Policy

BUILT_IN_PER_CATEGORY = 4
HISTORY = "history.json"


@dataclass(frozen=True, slots=True)
class RehearseCommand:
    """A simulated robot in place of a real one: it gives scans and outcomes, and executes what is proposed.

    Without --policy, standard input has the answers of `adaafford adapt --follow`, one a line, and standard output the
    lines that `adapt --follow` reads: a scan with the outcome of the last interaction. A program that carries lines
    between adapt and a robot is tested with this command in the robot's place. With --policy the session with that
    policy is in this process, and the result is printed. The same command goes on after an interruption.
    """

    folder: Annotated[OutFolder, tyro.conf.Positional]
    """Folder for scans, state and, with --policy, history and heatmap; created if missing."""
    task: str
    """A task by name, or a TOML file that defines one."""
    objects: Path | None = None
    """A folder of objects in PartNet-Mobility's layout; default: procedural objects."""
    policy: str | None = None
    """The name of a bundled policy, a folder with weights.safetensors and policy.json, or a finished run."""
    rollouts: Annotated[int, Field(ge=1, le=1000)] = 1
    """With --policy: how many objects with freshly drawn hidden dynamics, each in a folder of its own, are tried."""
    budget: int = 4
    """With --policy: the most interactions before the final action."""
    proposer: str = "aip-spread"
    """With --policy: what chooses these interactions, as for `adapt`."""
    goal: float | None = None
    """With --policy: go on until the part has moved so far from where it was at first, rad or m."""
    within: int = 6
    """With --goal: the most interactions, those of --budget included."""
    repeat: bool = False
    """With --goal: execute the first final action again and again, for comparison."""
    noise: float = 1.0
    """Strength of the scans' errors: 0 is none, 1 a structured-light camera one metre from the object."""
    marked: bool = True
    """Whether scans mark the points of the part that is to be moved."""
    arm: str | None = None
    """The arm that carries the hand, as for `adapt`: what it cannot reach is answered by "unreachable". The scans are
    then in a frame whose origin is its base. Without --policy, standard error says how `adapt` is to be called."""
    scene: bool = False
    """Scans are raw: the object stands on a floor, perhaps before walls and among other things, and nothing is marked.
    With --policy the session finds the part itself, as `adapt --part auto` does."""
    seed: int = 1
    """Everything random derives from it: objects, hidden dynamics, camera, states, noise, surroundings."""


def main(args: list[str]) -> int:
    """Rehearse."""
    from adaafford.histories import MAX_TRIES

    command = parse_flags(RehearseCommand, args, "rehearse", RehearseCommand(tyro.MISSING, tyro.MISSING))
    if command.policy is None and command.rollouts != 1:
        raise UsageError(f"--rollouts {command.rollouts}: needs --policy; a robot has one object in front of it")
    if not 0 <= command.noise <= MAX_NOISE:
        raise UsageError(f"--noise {command.noise}: allowed are 0 to {MAX_NOISE:g}")
    if not 1 <= command.budget <= 32:
        raise UsageError(f"--budget {command.budget}: allowed are 1 to 32")
    if command.policy is None and command.goal is not None:
        raise UsageError(f"--goal {command.goal}: needs --policy, which chooses the actions")
    if command.goal is not None and not 0 < command.goal <= 100:
        raise UsageError(f"--goal {command.goal}: allowed are more than 0 and at most 100, rad or m")
    if command.repeat and command.goal is None:
        raise UsageError("--repeat: says how a --goal is pursued; give one")
    if not command.budget < command.within <= MAX_TRIES:
        raise UsageError(f"--within {command.within}: allowed are {command.budget + 1}, after --budget, to {MAX_TRIES}")
    if command.seed < 0:
        raise UsageError(f"--seed {command.seed}: needs a number that is not negative")
    require("adaafford rehearse", "collect", without=("ray",))
    _refuse_other_sessions(command)
    if command.policy is None:
        return _follow(next(_robots(command, PANDA)))
    from adaafford.pretrained import load_policy
    from shared.tasks import task_of

    policy, task = load_policy(command.policy), task_of(command.task)
    policy.require_task(task.name, f"--policy {command.policy}", "--task is")
    ended = [_played(command, robot, policy) for robot in _robots(command, policy.gripper)]
    print(_summary(command, ended))
    return 0


def _folder(command: RehearseCommand, number: int) -> Path:
    """The folder of a rollout, from 0."""
    return command.folder if command.rollouts == 1 else command.folder / f"{number + 1:04d}"


def _refuse_other_sessions(command: RehearseCommand) -> None:
    """Refuse folders with the history of a session that was no rehearsal, which writes its own state first."""
    from cluster.evaluation.rehearsal import STATE

    for folder in (_folder(command, number) for number in range(command.rollouts)):
        if (folder / HISTORY).exists() and not (folder / STATE).exists():
            raise UsageError(f"{folder}: has the {HISTORY} of another session; name another folder")


def _robots(command: RehearseCommand, gripper: str) -> Iterator["SimulatedRobot"]:
    """The robots of the command, with this hand, each made when it is its turn."""
    from cluster.cli.library import simulated_again
    from cluster.config.objects import built_in_categories
    from cluster.evaluation.rehearsal import Setting, SimulatedRobot
    from collector.objects.procedural.catalogue import generate
    from shared.tasks import task_of

    make_folder(command.folder)
    objects = command.objects
    if objects is None:
        objects = command.folder / "objects"
        generate(objects, dict.fromkeys(built_in_categories(task_of(command.task), ()), BUILT_IN_PER_CATEGORY), 1)
    found = simulated_again(objects, command.task, command.seed, gripper, command.arm)
    for number, (environment, again) in enumerate(islice(found, command.rollouts)):
        folder = _folder(command, number)
        make_folder(folder)
        setting = Setting(
            task=task_of(command.task).name,
            object=environment.object.ref.id,
            seed=command.seed,
            number=number,
            noise=command.noise,
            marked=command.marked and not command.scene,
            arm=command.arm,
            scene=command.scene,
        )
        yield SimulatedRobot(environment, again, setting, folder)


def _follow(robot: "SimulatedRobot") -> int:
    """Execute the answers on standard input; print what a session reads."""
    from adaafford.histories import parse_json
    from adaafford.sessions import Step
    from cluster.cli.commands.adapt import answer_lines

    advice = "write an answer of adapt --follow"
    if robot.base is not None:
        base = " ".join(f"{number:.6f}" for number in robot.base)
        print(f"adaafford: adapt needs --arm and --base {base}", file=sys.stderr, flush=True)
    print(_line(robot.request), flush=True)
    answer_lines(advice, lambda line: _line(robot.execute(parse_json(Step, line, "", advice))))
    return 0


def _played(command: RehearseCommand, robot: "SimulatedRobot", policy: "Policy") -> bool:
    """A whole session with one robot; whether it succeeded."""
    from adaafford.parts import AUTO, PartError
    from adaafford.sessions import ReachError, Session, SessionFiles
    from cluster.evaluation.rehearsal import Goal, rehearse
    from shared.arms.arm import arm_of

    folder = robot.folder
    files = SessionFiles(folder / HISTORY, folder / "heatmap.ply")
    session = Session(
        policy,
        files,
        command.budget,
        command.seed,
        arm=None if command.arm is None else arm_of(command.arm),
        base=robot.base or (0.0, 0.0, 0.0, 0.0),
        part=AUTO if command.scene else None,
        proposer=command.proposer,
    )

    def tell(step: "Step", request: "Request") -> None:
        assert request.outcome is not None, "an action has an outcome"
        said = "success" if request.outcome.success else "failure"
        print(
            f"{folder.name} interaction {step.interaction} ({step.do}): belief {step.belief:.2f}, "
            f"{request.outcome.kind.value}, {said}, motion {request.outcome.motion:.3f}",
            flush=True,
        )

    goal = None if command.goal is None else Goal(command.goal, command.within, command.repeat)
    try:
        return rehearse(robot, session, tell, goal)
    except (PartError, ReachError) as error:
        print(plain(f"{folder.name} given up: {error}"), flush=True)
        return False


def _summary(command: RehearseCommand, ended: list[bool]) -> str:
    """How many rollouts succeeded, with a 95% interval."""
    from cluster.reporting.collecting import wilson

    what = "final actions succeeded" if command.goal is None else f"parts moved by {command.goal:g}"
    low, high = wilson(sum(ended), len(ended))
    share = sum(ended) / len(ended)
    return f"{sum(ended)} of {len(ended)} {what}: {100 * share:.0f}% [{100 * low:.0f}, {100 * high:.0f}]"


def _line(request: "Request") -> str:
    return request.model_dump_json(exclude_defaults=True)
