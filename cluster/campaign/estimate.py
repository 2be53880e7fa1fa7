"""The cost estimate of a campaign: interactions, core-hours and bytes by stage, from measured rates.

Nothing is simulated and nothing is written. The rates are of one core of the machine that `RATES` names, unloaded;
other machines differ by a factor, the shares of the stages hardly.
"""

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from rich.console import Console

from cluster.campaign.campaign import steps_of
from cluster.config.campaign_config import CampaignConfig
from cluster.config.objects import built_in_categories, lists_of, objects_for, split_as_told
from cluster.runs.subprocesses import THREADS
from collector.objects.catalogue import ObjectSplit
from learner.alternation import AlternationStep, Collect, Train
from learner.settings import AffordanceConfig
from learner.stages.trainers import settings_of, training_of
from shared.errors import UsageError
from shared.formatting import terminal_table
from shared.networks.network_config import NetworkConfig
from shared.plan import ObjectRef
from shared.policies.methods import METHODS, RANDOM, BaselineName
from shared.policies.policy import Policy
from shared.primitives import PRIMITIVES
from shared.tasks import Task
from shared.types import Order


@dataclass(frozen=True, slots=True)
class Rates:
    """Seconds of one core, and bytes."""

    measured: str = (
        "2026-11-22 on one core of an AMD EPYC (`adaafford bench collect` and `fidelity`; networks by themselves)"
    )
    """When, and on what."""
    push_s: float = 0.0054
    """A push at the fast fidelity; likewise of the other primitives that push."""
    pull_s: float = 0.020
    reference_push_s: float = 0.19
    """At the reference fidelity, whose timing is the published one."""
    reference_pull_s: float = 0.40
    object_s: float = 0.090
    """Reading an object, and letting a state come to rest."""
    look_s: float = 0.017
    """A depth image and its cloud."""
    write_s: float = 0.022
    """A rollout's share of a shard."""
    multiply_add_s: float = 9.1e-11
    """A multiplication in PointNet++, forward and backward."""
    cloud_s: float = 0.0085
    """What a cloud takes beside that."""
    scored_row_s: float = 5e-6
    """An action through a critic, forward."""
    trained_row_s: float = 12e-6
    """Forward and backward."""
    kept_pixel_s: float = 7.3e-9
    """A pixel of a depth image, packed and compressed."""
    read_pixel_s: float = 1.6e-8
    """Unpacked, and turned into a point."""
    profiled_point_s: float = 1.0e-3
    """The pinch profiles of actions at a point: what lies around it."""
    profile_s: float = 1.2e-5
    """One of these profiles."""
    point_bytes: float = 9.2
    """A point of a stored cloud."""
    depth_pixel_bytes: float = 0.038
    """A pixel of a stored depth image, most of which see nothing or a plane."""
    row_bytes: float = 385
    """A stored interaction without its cloud."""
    shard_bytes: float = 8600
    """What else a shard holds."""


RATES = Rates()
FORWARD_SHARE = 0.6
"""Of forward and backward."""
LEFT_BY_TRAINING = 5
"""Copies of the weights that a training stage leaves: latest, best, two moments of Adam, the policy."""


@dataclass(frozen=True, slots=True)
class StageCost:
    """The estimated cost of one stage."""

    stage: str
    interactions: int
    core_s: float
    size_bytes: float


@dataclass(frozen=True, slots=True)
class Estimate:
    """The estimated cost of a campaign.

    Attributes:
        task: its name.
        objects: number of training, validation and test objects.
        stages: in order.
    """

    task: str
    objects: tuple[int, int, int]
    stages: tuple[StageCost, ...]


def estimate(config: CampaignConfig, rates: Rates = RATES) -> Estimate:
    """The cost of a campaign.

    Raises:
        UsageError: a folder or list of objects cannot be read, or too few suit the task.
    """
    parts = _objects(config.task_record, config)
    counts = len(parts.train), len(parts.validation), len(parts.test)
    if not counts[0] or not counts[2]:
        raise UsageError(f"{sum(counts)} usable objects are too few to train on some and test on others")
    cost = _Costs(config, counts, rates).of
    return Estimate(config.task, counts, tuple(filter(None, map(cost, steps_of(config)))))


def _objects(task: Task, config: CampaignConfig) -> ObjectSplit:
    """The split that the campaign will make; built-in objects are counted without being made."""
    if config.objects is not None:
        catalogue, _ = objects_for(task, config, Path(), 0, config.seed, lists_of(config.splits))
        refs = [entry.ref for entry in catalogue.usable]
    else:
        refs = [
            ObjectRef(id=f"{category}-{number}", category=category, content_hash="0" * 64)
            for category in built_in_categories(task, config.categories)
            for number in range(config.procedural.per_category)
        ]
    return split_as_told(refs, config.splits, config.seed)


class _Costs:
    """What the steps of a campaign cost, asked for one after another."""

    def __init__(self, config: CampaignConfig, objects: tuple[int, int, int], rates: Rates) -> None:
        self.config, self.rates = config, rates
        self.task = config.task_record
        train, validation, self.tested = objects
        self.collected_on = train + validation
        camera, network = config.collection.camera, config.learner.network
        self.encode_s = rates.cloud_s + rates.multiply_add_s * multiply_adds(network, camera.points)
        with torch.device("meta"):
            weights = Policy(self.task.name, network).modules()
        self.weights_bytes = 4.0 * sum(tensor.numel() for tensor in weights.parameters())
        self.clouds = self.interactions = 0
        self._rows_a_rollout = config.collection.rollout.interactions

    def of(self, step: AlternationStep) -> StageCost | None:
        """The cost of a step, given those before it; None of one that costs next to nothing."""
        match step:
            case Collect(version=version):
                tries = self.config.collection.rollout.context if version else 0
                return self._collection(step.name, self.config.rollouts.of_round(version, self.collected_on), tries)
            case Train():
                return self._training(step)
            case AlternationStep(name="evaluate"):
                rollouts = self.config.rollouts
                return self._evaluation(rollouts.total(rollouts.evaluation, self.tested))
        return None

    def _collection(self, stage: str, rollouts: int, tries: int) -> StageCost:
        interactions = rollouts * self.config.collection.rollout.interactions
        clouds = rollouts * (self._clouds_a_rollout(tries))
        self.clouds += clouds
        self.interactions += interactions
        return StageCost(
            stage,
            interactions,
            self._simulation_s(rollouts, interactions, clouds) + rollouts * tries * self._policy_step_s(),
            self._stored_bytes(rollouts, interactions, clouds),
        )

    def _evaluation(self, rollouts: int) -> StageCost:
        """Random queries, then the interactions of every method, each with a new observation, and its actions."""
        told = self.config.evaluation
        methods = [METHODS.get(name) for name in told.methods]
        trying = list(methods)
        # Twice where there are tries: where these left the object, and where they began.
        chosen = sum(len(method.budgets(told.budgets)) * (2 if method.tries else 1) for method in methods)
        if told.exploit_share is not None:
            # Once more where they began, after tries of their own where these are drawn.
            chosen += sum(len(method.budgets(told.budgets)) for method in methods)
            trying += [method for method in methods if method.draws_tries]
        if told.repeats:
            chosen += sum(len(method.budgets(told.budgets)) for method in methods if method.tries)
        tries = [max(method.budgets(told.budgets)) if method.tries else 0 for method in trying]
        by_policy = chosen + sum(n for n, m in zip(tries, trying, strict=True) if m.tries not in (None, RANDOM))
        interactions = rollouts * (told.queries + sum(tries) + chosen)
        clouds = rollouts * (1 + sum(tries))
        judging_s = clouds * FORWARD_SHARE * self.encode_s * 3 + self._profiles_s(clouds, interactions, 1)
        return StageCost(
            "evaluate",
            interactions,
            self._simulation_s(rollouts, interactions, clouds)
            + rollouts * by_policy * self._policy_step_s()
            + judging_s,
            self._stored_bytes(rollouts, interactions, clouds) + self.weights_bytes,
        )

    def _training(self, step: Train) -> StageCost:
        """Its steps, and all clouds under encoders that the stages before it since the last collection did not have."""
        match step.network:
            case "prior":
                seconds, encoders = self._prior_s(), 1
            case "aap":
                seconds, encoders = self._aap_s(first=step.round == 1), 1 if step.round == 1 else 2
            case "aip":
                seconds, encoders = self._aip_s(), int(self.config.learner.aip.training == "paper")
            case _:
                seconds, encoders = self._baseline_s(step.network)
        encoding_s = self.clouds * encoders * FORWARD_SHARE * self.encode_s
        # The stages between two collections share what the first of them reads.
        if step.network == "prior" or (step.network == "aap" and step.round > 1):
            seconds += self._profiles_s(self.clouds, self.interactions, 1)
        return StageCost(step.name, 0, seconds + encoding_s, LEFT_BY_TRAINING * self.weights_bytes)

    def _prior_s(self) -> float:
        told = self.config.learner.prior
        actions = told.batch_clouds * told.actions_per_cloud
        # About one action in five succeeds and is sought among proposals.
        rows = actions * (1 + told.proposals // 5)
        return self._steps_s(told.steps, told.batch_clouds, rows) + self._affordance_s(told.affordance)

    def _aap_s(self, first: bool) -> float:
        told = self.config.learner.aap
        each, a_rollout = self._clouds_a_rollout(0), min(told.rows_per_rollout, self._rows_a_rollout)
        privileged = told.training == "privileged"
        rows = told.batch_rollouts * a_rollout * (told.context + 1)
        seconds = self._steps_s(told.steps, 0 if privileged else told.batch_rollouts * each, rows)
        if privileged and first:
            rollouts = told.oracle_batch_rollouts
            seconds += self._steps_s(told.oracle_steps, rollouts * each, rollouts * a_rollout)
        return seconds + self._affordance_s(told.affordance)

    def _aip_s(self) -> float:
        told = self.config.learner.aip
        clouds = told.batch_rollouts * self._clouds_a_rollout(0) if told.training == "paper" else 0
        rows = told.batch_rollouts * told.rows_per_rollout * told.draws * (told.context + 1)
        return self._steps_s(told.steps, clouds, rows) + self._affordance_s(told.affordance)

    def _baseline_s(self, name: BaselineName) -> tuple[float, int]:
        told = settings_of(self.config.learner, name)
        load = training_of(name).load(told)
        seconds = self._steps_s(told.steps, load.rollouts * self._clouds_a_rollout(0), load.rows)
        affordance = getattr(told, "affordance", None)
        return seconds + (self._affordance_s(affordance) if affordance is not None else 0.0), load.encoders

    def _affordance_s(self, told: AffordanceConfig) -> float:
        answered = told.questions * told.proposals * self.rates.scored_row_s
        answered += self._profiles_s(0, told.questions, told.proposals)
        return answered + self._steps_s(told.steps, 0, told.points)

    def _steps_s(self, steps: int, clouds: int, rows: int) -> float:
        return steps * (clouds * self.encode_s + rows * self.rates.trained_row_s)

    def _profiles_s(self, clouds: int, points: int, actions: int) -> float:
        """Reading depth images, and the profiles of so many actions at each point; nothing where none are used."""
        if not self.config.learner.network.pinch_profile:
            return 0.0
        rates, camera = self.rates, self.config.collection.camera
        at_a_point_s = rates.profiled_point_s + actions * rates.profile_s
        return clouds * camera.depth_size**2 * rates.read_pixel_s + points * at_a_point_s

    def _simulation_s(self, rollouts: int, interactions: int, clouds: int) -> float:
        primitive = PRIMITIVES.get(self.task.terms(self.config.collection).primitive)
        rates, pulls = self.rates, primitive.closes_fingers
        if self.config.collection.fidelity.name == "reference":
            trial_s = rates.reference_pull_s if pulls else rates.reference_push_s
        else:
            trial_s = rates.pull_s if pulls else rates.push_s
        look_s = rates.look_s + self.config.collection.camera.depth_size**2 * rates.kept_pixel_s
        return rollouts * (rates.object_s + rates.write_s) + interactions * trial_s + clouds * look_s

    def _policy_step_s(self) -> float:
        """One look of the prior, AAP and AIP, and a hundred proposals at every step."""
        points = self.config.collection.camera.points
        scored_s = 2 * (points + 100) * self.rates.scored_row_s
        return 3 * FORWARD_SHARE * self.encode_s + scored_s + self._profiles_s(1, 1, 100)

    def _clouds_a_rollout(self, tries: int) -> int:
        """How many observations a rollout has: one for each continuing interaction and for each drawn state."""
        told = self.config.collection.rollout
        if told.order is Order.CONTINUE and not tries:
            return told.interactions
        continued = min(tries or told.continued, told.interactions)
        left = told.interactions - continued
        return continued + (min(left, 1) if self.task.closed else -(-left // told.actions_per_state))

    def _stored_bytes(self, rollouts: int, interactions: int, clouds: int) -> float:
        rates, camera = self.rates, self.config.collection.camera
        shards = -(-rollouts // self.config.rollouts.per_shard)
        cloud_bytes = camera.points * rates.point_bytes + camera.depth_size**2 * rates.depth_pixel_bytes
        return interactions * rates.row_bytes + clouds * cloud_bytes + shards * rates.shard_bytes


def multiply_adds(network: NetworkConfig, points: int) -> float:
    """Multiplications of a forward pass of PointNet++ over one cloud."""
    sizes = [points, *(min(count, points) for count in network.centres)]
    total, width = 0, 0
    widths = [0]
    for size, layers in zip(sizes[1:], network.abstraction, strict=True):
        total += size * network.neighbours * _layers(width + 3, layers)
        width = layers[-1]
        widths.append(width)
    for level, layers in enumerate(network.propagation):
        fine = len(sizes) - 2 - level
        total += sizes[fine] * _layers(width + widths[fine], layers)
        width = layers[-1]
    return float(total)


def _layers(width: int, layers: tuple[int, ...]) -> int:
    return int(np.dot((width, *layers[:-1]), layers))


def print_estimate(estimate: Estimate, workers: int, rates: Rates) -> None:
    """Print the cost of each stage, and of all."""
    console = Console(highlight=False, width=None if sys.stdout.isatty() else 110)
    train, validation, test = estimate.objects
    rows, wall_s = [], 0.0
    for stage in estimate.stages:
        # Trials are shared by the workers; a network is trained by one process.
        stage_s = stage.core_s / (max(workers, 1) if stage.interactions else THREADS)
        wall_s += stage_s
        shown = f"{stage.interactions:,}" if stage.interactions else "-"
        rows.append((stage.stage, shown, _hours(stage.core_s), _hours(stage_s), _size(stage.size_bytes)))
    interactions = sum(stage.interactions for stage in estimate.stages)
    core_s = sum(stage.core_s for stage in estimate.stages)
    total = sum(stage.size_bytes for stage in estimate.stages)
    rows.append(("in all", f"{interactions:,}", _hours(core_s), _hours(wall_s), _size(total)))
    title = f"{estimate.task}: {train} objects to train on, {validation} to validate, {test} to test"
    table = terminal_table(title, ("stage", "interactions", "core-hours", "wall hours", "disk"), rows)
    table.rows[-1].style = "bold"
    console.print(table)
    console.print(
        f"wall hours    with {max(workers, 1)} workers for trials and {THREADS} threads for training\n"
        f"rates         measured {rates.measured}; expect a factor of two either way\n"
        "nothing was written",
        markup=False,
        soft_wrap=True,
    )


def _hours(seconds: float) -> str:
    hours = seconds / 3600
    return f"{hours:.2g}" if hours < 1 else f"{hours:,.1f}"


def _size(size_bytes: float) -> str:
    for unit, name in ((1e9, "GB"), (1e6, "MB")):
        if size_bytes >= unit:
            return f"{size_bytes / unit:,.1f} {name}"
    return f"{size_bytes / 1e3:,.0f} KB"
