"""The table: what each method knows after each budget of tries, and whether acting on it succeeds.

An evaluation store holds, for each rollout, random QUERY rows that critics are asked about; for each method, CONTEXT
rows, its tries in order; and for each method and budget, EXPLOIT rows, what the adapted affordance then chose.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from learner.data import Dataset, load_dataset
from learner.metrics import discrimination
from learner.sampling import frozen_features
from shared.errors import StoreError
from shared.policy import Policy
from shared.store.store import Store
from shared.vocabulary import Role

PRIOR_METHOD = "where2act"
NO_TRIES_METHOD = "aap-no-tries"
"""AAP before any try: a second, often stronger, prior to compare with."""


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


def evaluate_store(store: Store, policy: Policy, budgets: Sequence[int]) -> list[EvaluationRow]:
    """Evaluate a policy on an evaluation store.

    Raises:
        StoreError: the store is of another task, is damaged, or holds no QUERY row.
    """
    if store.setting.task != policy.task:
        raise StoreError(f"{store.path}: is of task '{store.setting.task}', but the policy of '{policy.task}'")
    return evaluate(load_dataset(store, policy.config), policy, budgets)


def evaluate(dataset: Dataset, policy: Policy, budgets: Sequence[int]) -> list[EvaluationRow]:
    """One row for each method and budget; Where2Act and AAP with no tries first, at budget 0.

    Raises:
        StoreError: there is no QUERY row.
    """
    policy.modules().eval()
    judge = _Judge(dataset, policy)
    adapted = sorted(set(dataset.rows.method.tolist()) - {"", PRIOR_METHOD, NO_TRIES_METHOD})
    return [
        judge.row(PRIOR_METHOD, 0),
        judge.row(NO_TRIES_METHOD, 0),
        *(judge.row(method, budget) for method in adapted for budget in budgets),
    ]


class _Judge:
    """Scores of the query rows under any context, with everything that does not depend on it computed once."""

    def __init__(self, dataset: Dataset, policy: Policy) -> None:
        rows = dataset.rows
        self.dataset, self.policy = dataset, policy
        self.queries = [index[rows.role[index.numpy()] == Role.QUERY.value] for index in dataset.rollouts]
        if not sum(map(len, self.queries)):
            raise StoreError("the store holds no query to judge by; evaluate on a store made by an evaluation plan")
        self.features = frozen_features(policy.aap.encoder, dataset.clouds, rows.cloud, rows.point)
        with torch.no_grad():
            self.codes, self.weights = policy.aap.interaction_codes(
                self.features, rows.xyz, rows.frame, rows.motion, rows.success
            )

    def row(self, method: str, budget: int) -> EvaluationRow:
        """The figures of a method at a budget."""
        contexts = [self._context(index, method, budget) for index in self.dataset.rollouts]
        pairs = [pair for pair in zip(self.queries, contexts, strict=True) if len(pair[0])]
        scores = [
            self._prior_scores(queries) if method == PRIOR_METHOD else self._adapted_scores(queries, context)
            for queries, context in pairs
        ]
        successes = self.dataset.rows.success[torch.cat([queries for queries, _ in pairs])]
        found = discrimination(torch.cat(scores).numpy(), successes.numpy())
        exploits = self._exploits(method, budget)
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
        )

    def _context(self, index: Tensor, method: str, budget: int) -> Tensor:
        """A rollout's first `budget` tries of a method; the rows of a rollout are in order of step."""
        rows, numbers = self.dataset.rows, index.numpy()
        return index[(rows.role[numbers] == Role.CONTEXT.value) & (rows.method[numbers] == method)][:budget]

    def _exploits(self, method: str, budget: int) -> NDArray[np.float32]:
        """Outcomes of the exploits; those of a prior count whatever budget they are listed under."""
        rows = self.dataset.rows
        chosen = (rows.role == Role.EXPLOIT.value) & (rows.method == method)
        if method not in (PRIOR_METHOD, NO_TRIES_METHOD):
            chosen &= rows.budget == budget
        return np.asarray(rows.success.numpy()[chosen], dtype=np.float32)

    @torch.no_grad()
    def _adapted_scores(self, queries: Tensor, context: Tensor) -> Tensor:
        rows, aap = self.dataset.rows, self.policy.aap
        latent = aap.latent(self.codes[context], self.weights[context])
        logits = aap.action_logits(self.features[queries], rows.xyz[queries], rows.frame[queries], latent)
        return torch.sigmoid(logits)

    @torch.no_grad()
    def _prior_scores(self, queries: Tensor) -> Tensor:
        rows, prior = self.dataset.rows, self.policy.prior
        features = frozen_features(prior.encoder, self.dataset.clouds, rows.cloud[queries], rows.point[queries])
        return torch.sigmoid(prior.action_logits(features, rows.xyz[queries], rows.frame[queries]))
