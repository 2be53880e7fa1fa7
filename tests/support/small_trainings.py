"""Stores, settings and steps for trainings that take a moment."""

import dataclasses
from pathlib import Path

import numpy as np
import torch

from learner.data.dataset import Dataset
from learner.data.sampling import Split
from learner.settings import AapConfig, AffordanceConfig, AipConfig, LearnerConfig, PriorConfig
from learner.training.loop import Stage, StepResult
from shared.plan import Job, Plan, RolloutRecord
from shared.store.store import Store
from tests.support.fabricate import fabricate_rollouts, fabricate_setting
from tests.support.small_networks import TINY

ROLLOUTS = 8


def make_store(path: Path, rollouts: list[RolloutRecord] | None = None, plan: Plan | None = None) -> Store:
    plan = plan or fabricated_plan()
    rollouts = fabricated_rollouts(plan) if rollouts is None else rollouts
    store = Store.create(path, plan.setting)
    store.add_plan(plan)
    store.commit(plan, Job(plan.key, 0, len(rollouts)), rollouts, {})
    return store


def coins(dataset: Dataset) -> Dataset:
    """All tries of a rollout succeed, or none does, as its first hidden fact says: otherwise only a try tells which."""
    success = torch.zeros(len(dataset.rows))
    for number, rows in enumerate(dataset.rollouts):
        success[rows] = float(number % 2)
    facts = torch.zeros_like(dataset.rows.facts)
    facts[:, 0] = success
    rows = dataclasses.replace(dataset.rows, success=success, motion=success * 0.3, facts=facts)
    return dataclasses.replace(dataset, rows=rows)


def fabricated_plan() -> Plan:
    return Plan(setting=fabricate_setting(objects=4, points=64))


def fabricated_rollouts(plan: Plan, count: int = ROLLOUTS) -> list[RolloutRecord]:
    return fabricate_rollouts(plan, Job(plan.key, 0, count), interactions=12, per_observation=4)


QUICK = AffordanceConfig(steps=4, validate_every=2, proposals=10, questions=64, points=16)


FAST = LearnerConfig(
    network=TINY,
    prior=PriorConfig(steps=4, validate_every=2, proposals=10, affordance=QUICK),
    aap=AapConfig(steps=4, validate_every=2, context=4, oracle_steps=4, affordance=QUICK),
    aip=AipConfig(steps=4, validate_every=2, affordance=QUICK),
)


EVERYTHING = Split(tuple(range(8)), tuple(range(8)))


def descend(stage: Stage, steps: int, rate: float = 5e-3) -> tuple[dict[str, float], dict[str, float]]:
    """Losses of one fixed batch before and after some steps on it."""
    groups = [{"params": list(group.parameters)} for group in stage.parameter_groups()]
    optimiser = torch.optim.Adam(groups, lr=rate)
    history = []
    for _ in range(steps):
        losses = stage.loss(np.random.default_rng(7)).losses
        history.append({name: float(loss.detach()) for name, loss in losses.items()})
        optimiser.zero_grad()
        torch.stack(list(losses.values())).sum().backward()
        optimiser.step()
    return history[0], history[-1]


class KilledError(Exception):
    """Stands for a kill."""


class Killed:
    """A stage that dies after some steps."""

    def __init__(self, stage: Stage, after: int) -> None:
        self.stage, self.left = stage, after
        self.name, self.module = stage.name, stage.module
        self.parameter_groups, self.validate = stage.parameter_groups, stage.validate

    def loss(self, rng: np.random.Generator) -> StepResult:
        self.left -= 1
        if self.left < 0:
            raise KilledError
        return self.stage.loss(rng)
