"""The table: what each method knows after each budget of tries, and whether acting on it succeeds.

An evaluation store holds, for each rollout, random QUERY rows that critics are asked about; for each method, CONTEXT
rows, its tries in order; and for each method and budget, EXPLOIT rows, what the adapted affordance then chose.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from learner.bootstrap import f_score_interval, ratio_interval
from learner.critics import OracleScores, RowCritic, row_critic
from learner.data import Dataset, load_dataset
from learner.features import FrozenFeatures
from learner.metrics import THRESHOLD, discrimination
from learner.oracle import OracleCritic
from shared.errors import StoreError
from shared.methods import METHODS, CriticName, method_named
from shared.policy import Policy
from shared.store.store import Store
from shared.tasks import task_named
from shared.vocabulary import Role

PRIOR_METHOD = "where2act"
NO_TRIES_METHOD = "aap-no-tries"
"""AAP before any try: a second, often stronger, prior to compare with."""
ORACLE_METHOD = "oracle"
"""A critic that is told the hidden facts: the bound of what tries can teach. It acts on nothing, so has no exploits."""


@dataclass(frozen=True, slots=True)
class EvaluationRow:
    """One method after one budget of tries, on all rollouts together; NaN where there was nothing to measure.

    Attributes:
        task: what was evaluated.
        method: whose tries.
        budget: how many tries a rollout, at the most.
        f_score: of the critic on the QUERY rows at the threshold 0.5.
        best_f_score: at the threshold best in hindsight.
        bce: binary cross entropy, nats.
        auc: area under the ROC curve.
        base_rate: share of successes among the QUERY rows.
        queries: how many QUERY rows.
        sample_success: share of the EXPLOIT rows that succeeded.
        trials: how many EXPLOIT rows.
        mean_tries: tries made a rollout, which stopping may leave below the budget.
        f_score_low: where its 95% interval over objects begins.
        f_score_high: where it ends.
        sample_success_low: where its 95% interval over objects begins.
        sample_success_high: where it ends.
    """

    task: str
    method: str
    budget: int
    f_score: float
    best_f_score: float
    bce: float
    auc: float
    base_rate: float
    queries: int
    sample_success: float
    trials: int
    mean_tries: float
    f_score_low: float
    f_score_high: float
    sample_success_low: float
    sample_success_high: float


def evaluate_store(
    store: Store, version: int, budgets: Sequence[int], oracle: OracleCritic | None = None
) -> list[EvaluationRow]:
    """Evaluate a policy version on an evaluation store that holds it, and what its methods did with others.

    Args:
        store: the evaluation store.
        version: which policy.
        budgets: numbers of tries.
        oracle: to judge beside it.

    Raises:
        StoreError: the store is damaged, holds no QUERY row, or lacks a policy that a method used.
    """
    policies = {version: Policy.from_files(store.read_policy(version))}
    dataset = load_dataset(store, policies[version].config)
    for method in _methods(dataset):
        used = method_named(method).policy_version(version)
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

    Where2Act, AAP with no tries and the oracle, where there is one, have a row of their own at budget 0.

    Args:
        dataset: the interactions.
        policies: that methods used, by version.
        version: the policy that is evaluated.
        budgets: numbers of tries.
        oracle: a critic that is told the hidden facts.

    Raises:
        StoreError: there is no QUERY row, or the data set is of a task with another primitive than a policy's.
    """
    for policy in policies.values():
        if task_named(policy.task).primitive is not task_named(dataset.task).primitive:
            raise StoreError(f"the store is of task '{dataset.task}', but a policy of '{policy.task}'")
        policy.modules().eval()
    judge = _Judge(dataset, policies)
    rows = [
        judge.row(PRIOR_METHOD, 0, judge.critic("where2act", version)),
        judge.row(NO_TRIES_METHOD, 0, judge.critic("aap", version)),
    ]
    if oracle is not None:
        rows.append(judge.row(ORACLE_METHOD, 0, OracleScores(oracle.eval(), judge.known)))
    for name in _methods(dataset):
        method = method_named(name)
        critic = judge.critic(method.critic, method.policy_version(version))
        rows += [judge.row(name, budget, critic) for budget in method.budgets(budgets)]
    return rows


def _methods(dataset: Dataset) -> list[str]:
    """Methods that made tries, in the order of the paper's table.

    Raises:
        StoreError: a row is of a method that there is not.
    """
    found = set(dataset.rows.method.tolist()) - {""}
    unknown = sorted(found - METHODS.keys())
    if unknown:
        raise StoreError(f"the store holds rows of method '{unknown[0][:40]}'; known: {', '.join(METHODS)}")
    return [name for name in METHODS if name in found and name != PRIOR_METHOD]


class _Judge:
    """Figures of critics on the query rows after what a method tried."""

    def __init__(self, dataset: Dataset, policies: Mapping[int, Policy]) -> None:
        rows = dataset.rows
        self.dataset, self.policies = dataset, policies
        self.known = FrozenFeatures(dataset)
        self.queries = [index[rows.role[index.numpy()] == Role.QUERY.value] for index in dataset.rollouts]
        if not sum(map(len, self.queries)):
            raise StoreError("the store holds no query to judge by; evaluate on a store made by an evaluation plan")
        self._critics: dict[tuple[CriticName, int], RowCritic] = {}
        numbers = {name: number for number, name in enumerate(sorted(set(dataset.objects)))}
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
        asked = torch.cat([queries for queries, _ in pairs])
        labels = self.dataset.rows.success[asked].numpy()
        believed = torch.cat(scores).numpy()
        found = discrimination(believed, labels)
        f_low, f_high = f_score_interval(believed >= THRESHOLD, labels > THRESHOLD, self._object_of[asked.numpy()])
        chosen = self._exploits(method, budget)
        exploits = self.dataset.rows.success.numpy()[chosen].astype(np.float64)
        success_low, success_high = ratio_interval(exploits, np.ones(len(exploits)), self._object_of[chosen])
        return EvaluationRow(
            task=self.dataset.task,
            method=method,
            budget=budget,
            f_score=found.f_score,
            best_f_score=found.best_f_score,
            bce=found.bce,
            auc=found.auc,
            base_rate=found.base_rate,
            queries=found.rows,
            sample_success=float(exploits.mean()) if len(exploits) else float("nan"),
            trials=len(exploits),
            mean_tries=float(np.mean([len(context) for _, context in pairs])),
            f_score_low=f_low,
            f_score_high=f_high,
            sample_success_low=success_low,
            sample_success_high=success_high,
        )

    def _context(self, index: Tensor, method: str, budget: int) -> Tensor:
        """A rollout's first `budget` tries of a method; the rows of a rollout are in order of step."""
        rows, numbers = self.dataset.rows, index.numpy()
        return index[(rows.role[numbers] == Role.CONTEXT.value) & (rows.method[numbers] == method)][:budget]

    def _exploits(self, method: str, budget: int) -> NDArray[np.int64]:
        """Rows of the exploits; those of a prior count whatever budget they are listed under."""
        rows = self.dataset.rows
        chosen = (rows.role == Role.EXPLOIT.value) & (rows.method == method)
        if method != PRIOR_METHOD:
            chosen &= rows.budget == budget
        return np.flatnonzero(chosen)
