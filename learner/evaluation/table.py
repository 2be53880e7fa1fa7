"""The table: what each method knows after each budget of interactions, and whether acting on it succeeds.

An evaluation store holds, for each rollout, random QUERY rows that critics are asked about; for each method, CONTEXT
rows, its interactions in order; and for each method and budget, EXPLOIT rows, what the adapted affordance then chose
where the interactions had left the object, and EXPLOIT_AT_START rows, what it chose where they had begun.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field
from torch import Tensor

from learner.data.dataset import Dataset, load_dataset
from learner.data.features import FrozenFeatures
from learner.metrics import THRESHOLD, discrimination, mix_for, ratio_interval, shifted_threshold
from learner.stages.oracle import OracleCritic, Teacher
from learner.stages.trainers import RowCritic, row_critic
from shared.errors import StoreError
from shared.formatting import finite
from shared.policies.methods import METHODS, CriticName
from shared.policies.policy import Policy
from shared.store.store import Store
from shared.tasks import TASKS, task_named
from shared.types import Role

PRIOR_METHOD = "where2act"
NO_TRIES_METHOD = "aap-no-tries"
"""AAP before any interaction: a second, often stronger, prior to compare with."""
ORACLE_METHOD = "oracle"
"""A critic that is told the hidden facts: the bound of what interactions can teach. It never acts."""

SHARES = {
    "f_score": (2, "hits", ("claimed", "true"), "queries"),
    "sample_success": (1, "successes", ("trials",), "trials"),
    "start_success": (1, "start_successes", ("start_trials",), "start_trials"),
    "mix_f_score": (2, "mix_hits", ("mix_claimed", "mix_true"), "mix_true"),
    "shifted_f_score": (2, "shifted_hits", ("shifted_claimed", "mix_true"), "mix_true"),
    "share_success": (1, "share_successes", ("share_trials",), "share_trials"),
    "repeat_success": (1, "repeat_successes", ("repeat_trials",), "repeat_trials"),
}
"""Figures that follow from counts by object, so that they have intervals over objects and can be pooled: how often they
count which column, the columns whose sum they divide it by, and the column that says which objects have any rows. An
F-score is 2 hits / (claimed + true)."""


@dataclass(frozen=True, slots=True)
class ObjectCounts:
    """What a row counts on each object, a column each; sums over objects, or over evaluations, are its figures.

    Attributes:
        object: its id.
        queries: QUERY rows.
        true: those that succeeded.
        claimed: those that the critic called successes.
        hits: those that both hold of.
        trials: EXPLOIT rows.
        successes: those that succeeded.
        start_trials: EXPLOIT_AT_START rows; where a method tries nothing, these are the EXPLOIT rows.
        start_successes: those that succeeded.
        mix_true: published rows that successful QUERY rows stand for (see `learner.metrics`). This and
            what follows is empty where it was not counted, as in results of older versions.
        mix_claimed: those that rows stand for which the critic called successes.
        mix_hits: those that both hold of.
        shifted_claimed: as `mix_claimed`, after the shift of the base rate.
        shifted_hits: those that both hold of.
        share_trials: EXPLOIT_BY_SHARE rows; empty where the evaluation executes none.
        share_successes: those that succeeded.
        repeat_trials: REPEAT_AT_START rows; likewise.
        repeat_successes: those that succeeded.
    """

    object: tuple[str, ...]
    queries: tuple[int, ...]
    true: tuple[int, ...]
    claimed: tuple[int, ...]
    hits: tuple[int, ...]
    trials: tuple[int, ...]
    successes: tuple[int, ...]
    start_trials: tuple[int, ...]
    start_successes: tuple[int, ...]
    mix_true: tuple[float, ...] = ()
    mix_claimed: tuple[float, ...] = ()
    mix_hits: tuple[float, ...] = ()
    shifted_claimed: tuple[float, ...] = ()
    shifted_hits: tuple[float, ...] = ()
    share_trials: tuple[int, ...] = ()
    share_successes: tuple[int, ...] = ()
    repeat_trials: tuple[int, ...] = ()
    repeat_successes: tuple[int, ...] = ()

    def share(self, name: str) -> tuple[float, float, float]:
        """One of `SHARES`, and its 95% interval over objects; NaN where nothing was counted that it divides by."""
        times, above, below, rows = SHARES[name]
        seen = np.flatnonzero(getattr(self, rows))
        over = times * np.asarray(getattr(self, above))[seen]
        under = np.sum([np.asarray(getattr(self, column))[seen] for column in below], axis=0)
        whole = float(over.sum() / under.sum()) if under.sum() else float("nan")
        return whole, *ratio_interval(over, under, seen)

    def shares(self) -> dict[str, float]:
        """All of `SHARES` by name, and where their intervals begin and end."""
        found: dict[str, float] = {}
        for name in SHARES:
            value, low, high = self.share(name)
            found |= {name: value, f"{name}_low": low, f"{name}_high": high}
        return found


class EvaluationRow(BaseModel):
    """One method after one budget of interactions, on all rollouts together; a row of results.json.

    A figure is None where there was nothing to measure, or where an older version did not measure it. Names that end in
    `_low` and `_high` are the limits of the figure's 95% interval over objects.

    Attributes:
        task: what was evaluated.
        method: whose interactions.
        budget: how many interactions a rollout, at the most.
        f_score: of the critic on the QUERY rows at the threshold 0.5.
        best_f: the F-score at the threshold best in hindsight.
        bce: binary cross entropy, nats.
        auc: area under the ROC curve.
        base_rate: share of successes among the QUERY rows.
        queries: how many QUERY rows.
        sample_success: share of the EXPLOIT rows that succeeded.
        start_success: share of the EXPLOIT_AT_START rows that succeeded.
        trials: how many EXPLOIT rows.
        mean_tries: interactions made a rollout, which stopping may leave below the budget.
        mix_f_score: as `f_score`, on the published mix of rows (see `learner.metrics`).
        shifted_f_score: the same after logits are shifted by logit(`mix_base_rate`) - logit(`base_rate`).
        share_success: share of the EXPLOIT_BY_SHARE rows that succeeded.
        repeat_success: share of the REPEAT_AT_START rows that succeeded.
        mix_base_rate: share of successes in the published mix of rows.
        counts: what these are of, by object.
        gap_closed: the share of the gap in F-score between Where2Act and the oracle.
    """

    model_config = ConfigDict(frozen=True, extra="ignore", allow_inf_nan=False)

    task: str = Field("", max_length=100)
    method: str = Field(max_length=100)
    budget: int
    f_score: float | None
    best_f: float | None
    bce: float | None
    auc: float | None
    base_rate: float | None
    queries: int
    sample_success: float | None
    start_success: float | None = None
    trials: int
    mean_tries: float | None
    f_score_low: float | None = None
    f_score_high: float | None = None
    sample_success_low: float | None = None
    sample_success_high: float | None = None
    start_success_low: float | None = None
    start_success_high: float | None = None
    mix_f_score: float | None = None
    mix_f_score_low: float | None = None
    mix_f_score_high: float | None = None
    shifted_f_score: float | None = None
    shifted_f_score_low: float | None = None
    shifted_f_score_high: float | None = None
    share_success: float | None = None
    share_success_low: float | None = None
    share_success_high: float | None = None
    repeat_success: float | None = None
    repeat_success_low: float | None = None
    repeat_success_high: float | None = None
    mix_base_rate: float | None = None
    counts: ObjectCounts | None = None
    gap_closed: float | None = None

    def value(self, measure: str) -> float | None:
        """One of the figures."""
        found: float | None = getattr(self, measure)
        return found

    def interval(self, measure: str) -> tuple[float, float] | None:
        """The limits of its 95% interval; None where it has none."""
        low, high = (getattr(self, f"{measure}_{end}", None) for end in ("low", "high"))
        return None if low is None or high is None else (low, high)


def evaluate_store(
    store: Store, version: int, budgets: Sequence[int], oracle: OracleCritic | None = None
) -> list[EvaluationRow]:
    """Evaluate a policy version on an evaluation store that holds it, and what its methods did with others.

    Raises:
        StoreError: the store is damaged, holds no QUERY row, or lacks a policy that a method used.
    """
    policies = {version: Policy.from_files(store.read_policy(version))}
    dataset = load_dataset(store, policies[version].config)
    for method in _methods(dataset):
        used = METHODS.get(method).policy_version(version)
        if used not in policies:
            policies[used] = Policy.from_files(store.read_policy(used))
    return evaluate(dataset, policies, version, budgets, oracle)


def evaluate(
    dataset: Dataset,
    policies: Mapping[int, Policy],
    version: int,
    budgets: Sequence[int],
    oracle: OracleCritic | None = None,
) -> list[EvaluationRow]:
    """One row for each method and budget that there are rows of.

    Where2Act, AAP with no interactions and the oracle, where they are trained, have a row of their own at budget 0.

    Args:
        dataset: the interactions.
        policies: that methods used, by version.
        version: the policy that is evaluated.
        budgets: numbers of interactions.
        oracle: a critic that is told the hidden facts.

    Raises:
        StoreError: there is no QUERY row, or the data set is of a task with another primitive than a policy's.
    """
    for policy in policies.values():
        primitive = _primitive(dataset.task) or dataset.primitive
        if policy.task != dataset.task and _primitive(policy.task) not in (None, primitive):
            raise StoreError(f"the store is of task '{dataset.task}', but a policy of '{policy.task}'")
        policy.modules().eval()
    judge = _Judge(dataset, policies)
    rows = [judge.row(PRIOR_METHOD, 0, judge.critic("where2act", version))]
    if "aap" in policies[version].trained:
        rows.append(judge.row(NO_TRIES_METHOD, 0, judge.critic("aap", version)))
    if oracle is not None:
        told = Teacher.of(oracle, judge.known).scores
        rows.append(judge.row(ORACLE_METHOD, 0, lambda asked, tries: told[asked]))
    for name in _methods(dataset):
        method = METHODS.get(name)
        critic = judge.critic(method.critic, method.policy_version(version))
        rows += [judge.row(name, budget, critic) for budget in method.budgets(budgets)]
    return rows


def _primitive(task: str) -> str | None:
    """What a task executes; None of one that a file defined, which whoever named both has compared."""
    return task_named(task).primitive if task in TASKS.names() else None


def _methods(dataset: Dataset) -> list[str]:
    """Methods that made interactions, in the order of the paper's table.

    Raises:
        StoreError: a row is of a method that there is not.
    """
    found = set(dataset.rows.method.tolist()) - {""}
    unknown = sorted(found.difference(METHODS.names()))
    if unknown:
        raise StoreError(f"the store holds rows of method '{unknown[0][:40]}'; known: {', '.join(METHODS.names())}")
    return [name for name in METHODS.names() if name in found and name != PRIOR_METHOD]


class _Judge:
    """Figures of critics on the query rows after what a method tried."""

    def __init__(self, dataset: Dataset, policies: Mapping[int, Policy]) -> None:
        rows = dataset.rows
        self.dataset, self.policies = dataset, policies
        self.known = FrozenFeatures(dataset)
        self.queries = [index[rows.role[index.numpy()] == Role.QUERY.value] for index in dataset.rollouts]
        if not sum(map(len, self.queries)):
            raise StoreError("the store holds no query to judge by; evaluate on a store made by an evaluation plan")
        self._success = rows.success.numpy() > THRESHOLD
        self._asked = torch.cat(self.queries).numpy()
        self._true = self._success[self._asked]
        mix, asked = mix_for(dataset.primitive), [index.numpy() for index in self.queries]
        self._weights = np.concatenate([mix.weights(self._success[own], rows.valid[own]) for own in asked])
        all_weights = float(self._weights.sum())
        self._mix_base_rate = float(self._weights[self._true].sum()) / all_weights if all_weights else float("nan")
        self._critics: dict[tuple[CriticName, int], RowCritic] = {}
        self._names = tuple(sorted(set(dataset.objects)))
        numbers = {name: number for number, name in enumerate(self._names)}
        self._object_of = np.zeros(len(rows.success), dtype=np.int64)
        for index, name in zip(dataset.rollouts, dataset.objects, strict=True):
            self._object_of[index.numpy()] = numbers[name]

    def critic(self, name: CriticName, version: int) -> RowCritic:
        """A critic of a policy, made once for all methods that share it."""
        if (name, version) not in self._critics:
            self._critics[name, version] = row_critic(name, self.policies[version], self.known)
        return self._critics[name, version]

    def row(self, method: str, budget: int, critic: RowCritic) -> EvaluationRow:
        """The figures of a method at a budget."""
        contexts = [self._context(index, method, budget) for index in self.dataset.rollouts]
        pairs = [pair for pair in zip(self.queries, contexts, strict=True) if len(pair[0])]
        scores = [critic(queries, context) for queries, context in pairs]
        believed = torch.cat(scores).numpy()
        found = discrimination(believed, self._true)
        shifted = believed >= shifted_threshold(found.base_rate, self._mix_base_rate)
        counts = self._counts(method, budget, believed >= THRESHOLD, shifted)
        figures = {
            "best_f": found.best_f_score,
            "bce": found.bce,
            "auc": found.auc,
            "base_rate": found.base_rate,
            "mean_tries": float(np.mean([len(context) for _, context in pairs])),
            "mix_base_rate": self._mix_base_rate,
            **counts.shares(),
        }
        numbers = {"budget": budget, "queries": found.rows, "trials": sum(counts.trials)}
        return EvaluationRow(task=self.dataset.task, method=method, counts=counts, **numbers, **finite(figures))

    def _counts(
        self,
        method: str,
        budget: int,
        claimed: NDArray[np.bool_],
        shifted: NDArray[np.bool_],
    ) -> ObjectCounts:
        """What a row counts; of each QUERY row, whether the critic called it a success, also after the shift."""
        asked, true, success = self._asked, self._true, self._success
        chosen = self._exploits(Role.EXPLOIT, method, budget)
        at_start = chosen if method == PRIOR_METHOD else self._exploits(Role.EXPLOIT_AT_START, method, budget)
        by_share, repeats = (
            self._exploits(role, method, budget) if role.value in self.dataset.rows.role else None
            for role in (Role.EXPLOIT_BY_SHARE, Role.REPEAT_AT_START)
        )

        def of_objects(rows: NDArray[np.int64] | None, those: NDArray[np.bool_] | None = None) -> tuple[int, ...]:
            if rows is None:
                return ()
            rows = rows if those is None else rows[those[rows]]
            return tuple(np.bincount(self._object_of[rows], minlength=len(self._names)).tolist())

        def published_rows(chosen: NDArray[np.bool_]) -> tuple[float, ...]:
            weights = self._weights[chosen]
            return tuple(np.bincount(self._object_of[asked[chosen]], weights, len(self._names)).tolist())

        return ObjectCounts(
            object=self._names,
            queries=of_objects(asked),
            true=of_objects(asked[true]),
            claimed=of_objects(asked[claimed]),
            hits=of_objects(asked[claimed & true]),
            trials=of_objects(chosen),
            successes=of_objects(chosen, success),
            start_trials=of_objects(at_start),
            start_successes=of_objects(at_start, success),
            mix_true=published_rows(true),
            mix_claimed=published_rows(claimed),
            mix_hits=published_rows(claimed & true),
            shifted_claimed=published_rows(shifted),
            shifted_hits=published_rows(shifted & true),
            share_trials=of_objects(by_share),
            share_successes=of_objects(by_share, success),
            repeat_trials=of_objects(repeats),
            repeat_successes=of_objects(repeats, success),
        )

    def _context(self, index: Tensor, method: str, budget: int) -> Tensor:
        """A rollout's first `budget` interactions of a method; the rows of a rollout are in order of step."""
        rows, numbers = self.dataset.rows, index.numpy()
        return index[(rows.role[numbers] == Role.CONTEXT.value) & (rows.method[numbers] == method)][:budget]

    def _exploits(self, role: Role, method: str, budget: int) -> NDArray[np.int64]:
        """Rows of the exploits; those of a prior count whatever budget they are listed under."""
        rows = self.dataset.rows
        chosen = (rows.role == role.value) & (rows.method == method)
        if method != PRIOR_METHOD:
            chosen &= rows.budget == budget
        return np.flatnonzero(chosen)
