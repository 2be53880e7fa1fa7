"""Do two fidelities give the same labels? The same trials are executed in both, each from the same joint positions."""

import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from collector.objects.catalogue import load_ref
from collector.random_proposer import RandomProposer
from collector.recorder import interact
from collector.rollout import draw_rollout, make_environment, object_of
from collector.sim.environment import SapienEnvironment, only_sapien
from collector.sim.trial import MOTION_THRESHOLD, Trial
from collector.stopwatch import StageClock
from shared import seeds
from shared.config import Fidelity
from shared.errors import UsageError
from shared.plan import Plan
from shared.primitives import PRIMITIVES
from shared.progress import Advance
from shared.types import Action, Observation, Outcome, OutcomeKind

STATES, ACTIONS = 2, 4
"""Of each rollout: states drawn, and actions tried from each. Few, so that the trials spread over many objects."""
NEAR_THRESHOLD = 0.008, 0.015
"""rad or length: a motion in the reference about the threshold of success, which the least difference decides."""
EMPTY_TURNS = 4
"""Turns over all objects without a single trial, after which there is nothing to be measured."""


@dataclass(frozen=True, slots=True)
class PairedTrial:
    """One trial in both fidelities; seconds are CPU time."""

    object_id: str
    reference: Outcome
    candidate: Outcome
    reference_s: float
    candidate_s: float


@dataclass(frozen=True, slots=True)
class FidelityResult:
    """How far the candidate agrees with the reference, which is taken for the truth.

    Attributes:
        trials: how many.
        objects: on how many objects.
        positives: successes in the reference.
        candidate_positives: successes in the candidate.
        label_agreement: share of trials with the same success.
        positive_f1: F1 of the successes; 1 where neither has any.
        kind_agreement: share of trials with the same outcome kind.
        near_threshold: trials whose motion in the reference is in `NEAR_THRESHOLD`.
        near_threshold_other_labels: how many of these have another label.
        clear_label_agreement: `label_agreement` of the others; NaN if there are none.
        clear_positive_f1: `positive_f1` of the others.
        motion_error_median: of |m - m'| over trials in which the joint moved in the reference; NaN if none did.
        motion_error_p95: its 95th percentile.
        reference_ms: mean CPU time of a trial.
        candidate_ms: likewise.
        confusions: the most frequent differences, as "kind success -> kind success" and how many.
    """

    trials: int
    objects: int
    positives: int
    candidate_positives: int
    label_agreement: float
    positive_f1: float
    kind_agreement: float
    near_threshold: int
    near_threshold_other_labels: int
    clear_label_agreement: float
    clear_positive_f1: float
    motion_error_median: float
    motion_error_p95: float
    reference_ms: float
    candidate_ms: float
    confusions: tuple[tuple[str, int], ...]

    def as_json(self) -> dict[str, Any]:
        """What `--json` prints."""
        told = asdict(self) | {"fast_ms": self.candidate_ms, "confusions": dict(self.confusions)}
        del told["candidate_ms"]
        return told


def compare(
    plan: Plan, folder: Path, reference: Fidelity, candidate: Fidelity, trials: int, advance: Advance
) -> FidelityResult:
    """Execute random trials, drawn as the collector draws them, in both fidelities.

    Args:
        plan: task, objects and seed; its own fidelity is not used.
        folder: of the objects.
        reference: the truth.
        candidate: what is judged. States settle, and are observed, in this one.
        trials: how many.
        advance: called after each.

    Raises:
        UsageError: no object shows anything that the task could act on.
    """
    pairs: list[PairedTrial] = []
    plans = _with_fidelity(plan, reference), _with_fidelity(plan, candidate)
    index = 0
    while len(pairs) < trials:
        if not pairs and index >= EMPTY_TURNS * len(plan.setting.objects):
            raise UsageError(f"{folder}: no object comes to rest in view of the camera; look at `adaafford objects`")
        for pair in _rollout(*plans, folder, index):
            pairs.append(pair)
            advance()
            if len(pairs) == trials:
                break
        index += 1
    return summarise(pairs)


def summarise(pairs: list[PairedTrial]) -> FidelityResult:
    """The figures of paired trials, of which there is at least one."""
    truth = np.array([pair.reference.success for pair in pairs])
    label = np.array([pair.candidate.success for pair in pairs])
    motions = np.array([[pair.reference.motion, pair.candidate.motion] for pair in pairs])
    errors = np.abs(motions[:, 1] - motions[:, 0])[motions[:, 0] > MOTION_THRESHOLD]
    near = (motions[:, 0] > NEAR_THRESHOLD[0]) & (motions[:, 0] < NEAR_THRESHOLD[1])
    differences = Counter(
        f"{_described(pair.reference)} -> {_described(pair.candidate)}"
        for pair in pairs
        if _described(pair.reference) != _described(pair.candidate)
    )
    return FidelityResult(
        trials=len(pairs),
        objects=len({pair.object_id for pair in pairs}),
        positives=int(truth.sum()),
        candidate_positives=int(label.sum()),
        label_agreement=float((truth == label).mean()),
        positive_f1=_f1(truth, label),
        kind_agreement=float(np.mean([pair.reference.kind is pair.candidate.kind for pair in pairs])),
        near_threshold=int(near.sum()),
        near_threshold_other_labels=int((truth != label)[near].sum()),
        clear_label_agreement=float((truth == label)[~near].mean()) if not near.all() else float("nan"),
        clear_positive_f1=_f1(truth[~near], label[~near]),
        motion_error_median=float(np.median(errors)) if len(errors) else float("nan"),
        motion_error_p95=float(np.percentile(errors, 95)) if len(errors) else float("nan"),
        reference_ms=1e3 * float(np.mean([pair.reference_s for pair in pairs])),
        candidate_ms=1e3 * float(np.mean([pair.candidate_s for pair in pairs])),
        confusions=tuple(differences.most_common(8)),
    )


def _f1(truth: NDArray[np.bool_], label: NDArray[np.bool_]) -> float:
    """Of the successes; 1 where neither has any."""
    positives = int(truth.sum() + label.sum())
    return 2 * int((truth & label).sum()) / positives if positives else 1.0


def _described(outcome: Outcome) -> str:
    return f"{outcome.kind.value}{' success' if outcome.success else ''}"


def _with_fidelity(plan: Plan, fidelity: Fidelity) -> Plan:
    collection = plan.setting.collection.model_copy(update={"fidelity": fidelity})
    return plan.model_copy(update={"setting": plan.setting.model_copy(update={"collection": collection})})


def _rollout(reference: Plan, candidate: Plan, folder: Path, index: int) -> Iterator[PairedTrial]:
    """The trials of one rollout: its object and draws are the collector's for this number."""
    seed, key = candidate.setting.seed, candidate.key
    collision = candidate.setting.collection.collision
    target, draw = load_ref(folder, object_of(candidate, index), collision), draw_rollout(candidate, index)
    truth, judged = (only_sapien(make_environment(plan, draw, target, StageClock())) for plan in (reference, candidate))
    proposer = RandomProposer(seeds.generator(seed, f"actions/{key}", index), candidate.setting.terms.edge_share)
    # Both draw the same states from streams of their own, so that both learn the same hidden direction mode.
    streams = [seeds.generator(seed, f"states/{key}", index, 0) for _ in range(2)]
    pair: PairedTrial

    def execute_both(observation: Observation, action: Action) -> Outcome:
        nonlocal pair
        part = int(observation.part_ids[action.point_index])
        truth.restore(judged.state())
        expected, expected_s = _execute(truth, reference, action, part)
        got, got_s = _execute(judged, candidate, action, part)
        pair = PairedTrial(target.ref.id, expected, got, expected_s, got_s)
        return got

    for _ in range(STATES):
        truth.reset(streams[0])
        if not (judged.reset(streams[1]) and judged.shows_a_target()):
            continue
        for _ in interact(judged, proposer, ACTIONS, start=judged.state(), execute=execute_both):
            yield pair
            if OutcomeKind.UNSTABLE in (pair.reference.kind, pair.candidate.kind):
                return  # Nothing that these scenes show later can be believed.


def _execute(environment: SapienEnvironment, plan: Plan, action: Action, part: int) -> tuple[Outcome, float]:
    """An outcome, and the CPU seconds that it took."""
    begun = time.process_time()
    primitive = PRIMITIVES.get(environment.primitive)
    outcome = Trial(environment.scene, action, part, primitive, plan.setting.collection.fidelity).run()
    return outcome, time.process_time() - begun
