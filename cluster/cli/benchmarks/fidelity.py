"""Do fidelities give the labels of a reference? The same trials are executed in all, each from the same positions."""

import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from collector.objects.articulation import ArticulatedObject
from collector.objects.catalogue import load_ref
from collector.random_proposer import RandomProposer
from collector.rollout import Draw, draw_rollout, make_environment, object_of
from collector.sim.environment import only_sapien
from collector.sim.restoration import first_positions
from collector.sim.scene import Scene
from collector.sim.simulator import StageClock
from collector.sim.trial import MOTION_THRESHOLD, Trial
from learner.metrics import ratio_interval
from shared import seeds
from shared.config import Fidelity
from shared.errors import UsageError
from shared.plan import Plan
from shared.primitives import PRIMITIVES
from shared.progress import Advance
from shared.types import Action, Direction, Float, Outcome, OutcomeKind

STATES, ACTIONS = 2, 4
"""Of each rollout: states drawn, and actions tried from each. Few, so that the trials spread over many objects."""
NEAR_THRESHOLD = 0.008, 0.015
"""rad or length: a motion in the reference about the threshold of success, which the least difference decides."""
MOVED = 0.002
"""rad or length: a trial in which a candidate moves the joint by more is always executed in the reference, too."""
DISPLACED = 1e-5
"""m: by how much the hand is placed beside where it was, to see how far the reference agrees with itself."""
EMPTY_TURNS = 4
"""Turns over all objects without a single trial, after which there is nothing to be measured."""


@dataclass(frozen=True, slots=True)
class PairedTrial:
    """One trial in both fidelities; seconds are CPU time.

    Attributes:
        weight: how many drawn trials it stands for.
    """

    object_id: str
    reference: Outcome
    candidate: Outcome
    reference_s: float
    candidate_s: float
    weight: float = 1.0


@dataclass(frozen=True, slots=True)
class FidelityResult:
    """How far the candidate agrees with the reference, which is taken for the truth.

    Shares, F1 and mean times count each trial as often as its weight says; counts and errors of m count it once.

    Attributes:
        trials: how many were executed in both.
        stands_for: how many drawn trials these stand for.
        objects: on how many objects.
        positives: successes in the reference.
        candidate_positives: successes in the candidate.
        label_agreement: share of trials with the same success.
        positive_f1: F1 of the successes; 1 where neither has any.
        positive_f1_low: the 2.5th percentile of `positive_f1` when objects are drawn anew with replacement.
        positive_f1_high: the 97.5th percentile.
        kind_agreement: share of trials with the same outcome kind.
        near_threshold: trials whose motion in the reference is in `NEAR_THRESHOLD`.
        near_threshold_other_labels: how many of these have another label.
        clear_label_agreement: `label_agreement` of the others; NaN if there are none.
        clear_positive_f1: `positive_f1` of the others.
        motion_error_median: of |m - m'| over trials in which the joint moved in the reference; NaN if none did.
        motion_error_p95: its 95th percentile.
        reference_ms: mean CPU time of a trial.
        candidate_ms: likewise.
        candidate_steps: mean number of the engine's steps in a trial.
        confusions: the most frequent differences, as "kind success -> kind success" and how many.
    """

    trials: int
    stands_for: float
    objects: int
    positives: int
    candidate_positives: int
    label_agreement: float
    positive_f1: float
    positive_f1_low: float
    positive_f1_high: float
    kind_agreement: float
    near_threshold: int
    near_threshold_other_labels: int
    clear_label_agreement: float
    clear_positive_f1: float
    motion_error_median: float
    motion_error_p95: float
    reference_ms: float
    candidate_ms: float
    candidate_steps: float
    confusions: tuple[tuple[str, int], ...]

    def as_json(self) -> dict[str, Any]:
        """What `--json` prints."""
        told = asdict(self) | {"fast_ms": self.candidate_ms, "confusions": dict(self.confusions)}
        del told["candidate_ms"]
        return told


@dataclass(frozen=True, slots=True)
class DrawnTrial:
    """A trial before it is executed: joint positions, [parts], action, and the part (1-based) that it touches."""

    positions: Float
    action: Action
    part: int


@dataclass(frozen=True, slots=True)
class DrawnRollout:
    """The trials of one rollout, as the collector draws them, and what a scene for them needs."""

    target: ArticulatedObject
    draw: Draw
    limits: Float
    trials: tuple[DrawnTrial, ...]


Timed = tuple[Outcome, float]
"""An outcome, and the CPU seconds that it took."""


def compare(
    plan: Plan,
    folder: Path,
    reference: Fidelity,
    candidates: Sequence[Fidelity],
    trials: int,
    advance: Advance,
    quiet_share: float = 1.0,
    again: bool = False,
) -> list[FidelityResult]:
    """Execute random trials, drawn as the collector draws them, in the reference and in each candidate.

    Args:
        plan: task, objects, seed, and the fidelity in which states settle; trials do not depend on the candidates.
        folder: of the objects.
        reference: the truth.
        candidates: what is judged.
        trials: how many.
        advance: called after each.
        quiet_share: of the trials in which every candidate has the same kind and none moves the joint by more than
            `MOVED`, the share that is executed in the reference; each then counts for 1 / `quiet_share` trials.
        again: whether to execute the trials of the reference again in it, with the hand `DISPLACED`.

    Returns:
        The figures of each candidate and, with `again`, last those of the reference against itself.

    Raises:
        UsageError: no object shows anything that the task could act on.
    """
    pairs: list[list[PairedTrial]] = [[] for _ in range(len(candidates) + again)]
    done = index = 0
    while done < trials:
        if not done and index >= EMPTY_TURNS * len(plan.setting.objects):
            raise UsageError(f"{folder}: no object comes to rest in view of the camera; look at `adaafford objects`")
        rollout = draw_trials(plan, folder, index)
        every = range(min(len(rollout.trials), trials - done))
        judged = [execute(plan, fidelity, rollout, every) for fidelity in candidates]
        sound = min(len(outcomes) for outcomes in judged)
        rng = seeds.generator(plan.setting.seed, "bench/fidelity", index)
        weights = _weights(judged, sound, quiet_share, rng)
        truths = execute(plan, reference, rollout, sorted(weights))
        if again:
            judged.append(execute(plan, reference, _displaced(rollout, rng), sorted(weights)))
        for k, truth in truths.items():
            for listed, outcomes in zip(pairs, judged, strict=True):
                if k not in outcomes:
                    continue
                pair = PairedTrial(
                    rollout.target.ref.id, truth[0], outcomes[k][0], truth[1], outcomes[k][1], weights[k]
                )
                listed.append(pair)
        for _ in range(sound):
            advance()
        done, index = done + sound, index + 1
    return [summarise(listed) for listed in pairs]


def draw_trials(plan: Plan, folder: Path, index: int) -> DrawnRollout:
    """Draw the trials of one rollout; its object, hidden dynamics, states and actions are the collector's."""
    seed, key = plan.setting.seed, plan.key
    target = load_ref(folder, object_of(plan, index), plan.setting.collection.collision)
    draw = draw_rollout(plan, index)
    environment = only_sapien(make_environment(plan, draw, target, StageClock()))
    states = seeds.generator(seed, f"states/{key}", index, 0)
    proposer = RandomProposer(seeds.generator(seed, f"actions/{key}", index), plan.setting.terms.edge_share)
    trials = []
    for _ in range(STATES):
        if not (environment.reset(states) and environment.shows_a_target()):
            continue
        observation, positions = environment.observe(), environment.state()
        for _ in range(ACTIONS):
            action = proposer.propose(observation, ())
            assert action is not None, "random proposers never stop"
            trials.append(DrawnTrial(positions, action, int(observation.part_ids[action.point_index])))
    return DrawnRollout(target, draw, environment.scene.limits, tuple(trials))


def execute(plan: Plan, fidelity: Fidelity, rollout: DrawnRollout, which: Sequence[int]) -> dict[int, Timed]:
    """Execute some trials of a rollout in a scene of their own.

    Returns:
        By number of the trial; nothing after one that was unstable, since such a scene shows nothing more that counts.
    """
    outcomes: dict[int, Timed] = {}
    if not which:
        return outcomes
    primitive = PRIMITIVES.get(plan.setting.primitive)
    dynamics = rollout.draw.dynamics
    scene = Scene(rollout.target, dynamics, fidelity, primitive, plan.setting.collection.gripper)
    if dynamics.direction is not Direction.AS_BUILT:
        scene.restrict(first_positions(rollout.limits, dynamics.direction))
    for k in which:
        drawn = rollout.trials[k]
        scene.put(drawn.positions)
        begun = time.process_time()
        outcome = Trial(scene, drawn.action, drawn.part, primitive, fidelity).run()
        outcomes[k] = outcome, time.process_time() - begun
        if outcome.kind is OutcomeKind.UNSTABLE:
            break
    return outcomes


def _displaced(rollout: DrawnRollout, rng: np.random.Generator) -> DrawnRollout:
    """The same trials, with the hand placed beside where it was, in a random direction."""
    trials = []
    for drawn in rollout.trials:
        direction = rng.normal(size=3)
        point = drawn.action.point + DISPLACED * direction / np.linalg.norm(direction)
        trials.append(replace(drawn, action=replace(drawn.action, point=point)))
    return replace(rollout, trials=tuple(trials))


def _weights(
    judged: Sequence[dict[int, Timed]], sound: int, quiet_share: float, rng: np.random.Generator
) -> dict[int, float]:
    """How many trials each one stands for that is executed in the reference, by number."""
    weights = {}
    for k, drawn in enumerate(rng.random(sound)):
        outcomes = [outcomes[k][0] for outcomes in judged]
        if len({outcome.kind for outcome in outcomes}) > 1 or any(o.success or o.motion > MOVED for o in outcomes):
            weights[k] = 1.0
        elif drawn < quiet_share:
            weights[k] = 1.0 / quiet_share
    return weights


def summarise(pairs: Sequence[PairedTrial]) -> FidelityResult:
    """The figures of paired trials; NaN where there is none."""
    truth = np.array([pair.reference.success for pair in pairs], dtype=bool)
    label = np.array([pair.candidate.success for pair in pairs], dtype=bool)
    weight = np.array([pair.weight for pair in pairs])
    motions = np.array([[pair.reference.motion, pair.candidate.motion] for pair in pairs]).reshape(-1, 2)
    errors = np.abs(motions[:, 1] - motions[:, 0])[motions[:, 0] > MOTION_THRESHOLD]
    near = (motions[:, 0] > NEAR_THRESHOLD[0]) & (motions[:, 0] < NEAR_THRESHOLD[1])
    same_kind = np.array([pair.reference.kind is pair.candidate.kind for pair in pairs], dtype=bool)
    differences = Counter(
        f"{_described(pair.reference)} -> {_described(pair.candidate)}"
        for pair in pairs
        if _described(pair.reference) != _described(pair.candidate)
    )
    objects = np.unique([pair.object_id for pair in pairs], return_inverse=True)[1]
    low, high = ratio_interval(2.0 * weight * (truth & label), weight * truth + weight * label, objects)
    return FidelityResult(
        trials=len(pairs),
        stands_for=float(weight.sum()),
        objects=len(np.unique(objects)),
        positives=int(truth.sum()),
        candidate_positives=int(label.sum()),
        label_agreement=_mean(truth == label, weight),
        positive_f1=_f1(truth, label, weight),
        positive_f1_low=low,
        positive_f1_high=high,
        kind_agreement=_mean(same_kind, weight),
        near_threshold=int(near.sum()),
        near_threshold_other_labels=int((truth != label)[near].sum()),
        clear_label_agreement=_mean((truth == label)[~near], weight[~near]),
        clear_positive_f1=_f1(truth[~near], label[~near], weight[~near]),
        motion_error_median=float(np.median(errors)) if len(errors) else float("nan"),
        motion_error_p95=float(np.percentile(errors, 95)) if len(errors) else float("nan"),
        reference_ms=1e3 * _mean(np.array([pair.reference_s for pair in pairs]), weight),
        candidate_ms=1e3 * _mean(np.array([pair.candidate_s for pair in pairs]), weight),
        candidate_steps=_mean(np.array([float(pair.candidate.steps) for pair in pairs]), weight),
        confusions=tuple(differences.most_common(8)),
    )


def _mean(values: NDArray[Any], weight: Float) -> float:
    """The weighted mean; NaN of nothing."""
    return float(np.average(values, weights=weight)) if len(values) else float("nan")


def _f1(truth: NDArray[np.bool_], label: NDArray[np.bool_], weight: Float) -> float:
    """Of the successes; 1 where neither has any."""
    positives = float(weight @ truth + weight @ label)
    return 2 * float(weight @ (truth & label)) / positives if positives else 1.0


def _described(outcome: Outcome) -> str:
    return f"{outcome.kind.value}{' success' if outcome.success else ''}"
