"""The campaign: the alternation over one folder, from the choice of objects to the report.

    objects, collect-random, train-prior,
    train-aap-1, train-aip-1, publish-1,        (a run that starts from a policy has `adopt` for the three trainings)
    collect-aip-1, train-aap-2, train-aip-2, publish-2, ...
    (before the last publication train-where2act-interaction, train-where2act-adaptation, where they are evaluated)
    evaluate, report

The same live workers serve every collection round; each round's policy reaches them by version.
"""

import sys
from collections.abc import Mapping
from contextlib import closing, suppress
from dataclasses import replace
from functools import partial
from typing import Any

from rich.console import Console

from cluster.collection.driver import collect
from cluster.config.campaign_config import CampaignConfig
from cluster.config.objects import lists_of, objects_for, split_as_told
from cluster.evaluation.evaluate import Evaluation, figures_of
from cluster.runs.run_folder import ObjectsUsed, RunFolder
from cluster.runs.run_log import RunLog
from cluster.runs.subprocesses import THREADS, Child
from cluster.runs.warm_start import fit_to_start_from, seen_by, unknown, warm_start
from cluster.workers.session import CurrentWorkerGroup, worker_groups
from collector.setting import make_setting, packages_used
from learner.alternation import AlternationStep, Collect, Publish, alternation, perform
from learner.settings import LearnerConfig
from learner.stages.jobs import StageJob, as_json
from shared.errors import AdaAffordError, UsageError
from shared.io.files import DRIVER_LOCK, exclusive_lock, read_bounded, write_atomically
from shared.io.text import plain
from shared.plan import Plan, Setting
from shared.policies.methods import baselines_of
from shared.policies.policy import MAX_WEIGHTS_BYTES, POLICY_FILE, WEIGHTS_FILE
from shared.software import software_versions
from shared.store import Store
from shared.store.provenance import changed_versions


def steps_of(config: CampaignConfig) -> list[AlternationStep]:
    """All steps of a campaign, in order; a step may be repeated if a kill comes before its log entry."""
    rounds = alternation(
        lambda number: number <= config.alternations,
        adopts=config.start_from is not None,
        baselines=baselines_of(config.evaluation.methods),
    )
    return [AlternationStep("objects"), *rounds, AlternationStep("evaluate"), AlternationStep("report")]


class Campaign:
    """One run, which starts or continues and ends with its report.

    It implements `Rollouts` for its alternation, because it collects them itself.
    """

    _worker_group: CurrentWorkerGroup

    def __init__(self, run: RunFolder, config: CampaignConfig) -> None:
        self._run = run
        self._config = config
        self._console = Console(file=sys.stderr, highlight=False)
        self._learner = Child(lambda line: self._say(f"  {line}"), run.path)

    def execute(self) -> None:
        """Execute the remaining steps.

        Raises:
            AdaAffordError: a step failed; finished steps stay finished.
        """
        run, config, steps = self._run, self._config, steps_of(self._config)
        with exclusive_lock(run.path / DRIVER_LOCK), closing(self._learner):
            run_log = RunLog(run.log)
            run_log.note("attempt", workers=config.workers, software=software_versions())
            for place in (run.store, run.evaluation):
                # A step that has finished does not look into its store again; others say what is wrong with theirs.
                with suppress(AdaAffordError):
                    Store.open(place).sweep()
            changed = changed_versions(run.begun_with())
            if changed and any(step.name not in run_log.finished for step in steps):
                self._say(f"begun with other software: {changed}; new results may differ because of it")
            with worker_groups(config.workers, config.limits, config.ray_address) as make_worker_group:
                self._worker_group = CurrentWorkerGroup(make_worker_group)
                run_log.run({step.name: partial(self._do, step) for step in steps}, self._say)
            from cluster.reporting.printed import print_report

            print_report(run)

    def _do(self, step: AlternationStep) -> Mapping[str, Any]:
        match step.name:
            case "objects":
                return self._choose_objects()
            case "adopt":
                assert self._config.start_from is not None, "the run starts from a policy"
                warm_start(self._config.start_from, self._config.task, self._run.adopted)
                return {"policy_folder": str(self._run.adopted.relative_to(self._run.path))}
            case "evaluate":
                return self._evaluate()
            case "report":
                return self._report()
        return perform(step, self, self._train)

    def collect(self, step: Collect) -> Mapping[str, Any]:
        """Collect the missing rollouts of a round."""
        store, folder, rollouts = Store.open(self._run.store), self._run.objects_folder(), self._config.rollouts
        plan = Plan(setting=store.setting, proposer=step.proposer, policy_version=step.version)
        wanted = rollouts.of_round(step.version, len(store.setting.objects))
        with store.only_driver():
            open_worker_group = partial(self._worker_group.for_store, store, folder)
            collected = collect(store, plan, wanted, rollouts.per_shard, open_worker_group, folder)
        return figures_of(collected)

    def job(self, number: int) -> StageJob:
        """The training job of a round, which uses all rollouts of the store."""
        used = self._run.objects_used()
        train, validation = (frozenset(ref.id for ref in refs) for refs in (used.train, used.validation))
        return StageJob("prior", self._run.store, self._run.trainings, None, train, validation or None)

    def publish(self, step: Publish) -> Mapping[str, Any]:
        """Publish a policy in the store for the collectors."""
        # They want the learner's cores and its memory.
        self._learner.close()
        folder = self._run.training(step.folder)
        files = {name: read_bounded(folder / name, MAX_WEIGHTS_BYTES) for name in (WEIGHTS_FILE, POLICY_FILE)}
        Store.open(self._run.store).publish_policy(step.version, files)
        self._say(f"published policy {step.version}, {sum(map(len, files.values())) / 1e6:.1f} MB")
        return {"policy": step.version}

    def _train(self, job: StageJob) -> None:
        told = LearnerConfig(seed=self._config.seed, threads=THREADS, **dict(self._config.learner))
        self._learner.run("learner.stages.jobs:run_from_json", as_json(job, told), job.out)

    def _choose_objects(self) -> Mapping[str, Any]:
        """Decide which objects are trained on and which are kept for the end, and make both stores."""
        run, config = self._run, self._config
        task = config.task_record
        # What cannot be found is refused before any object is read.
        packages_used(task, config.collection, config.evaluation)
        per_category = config.procedural.per_category
        built_in, lists = run.generated_objects.resolve(), lists_of(config.splits)
        catalogue, folder = objects_for(task, config, built_in, per_category, config.seed, lists)
        parts = split_as_told((entry.ref for entry in catalogue.usable), config.splits, config.seed)
        if config.start_from is not None:
            policy = fit_to_start_from(config.start_from, config.task)
            policy.check_camera(config.collection.camera)
            policy.warn_of_other_hand(config.collection.gripper)
            seen = seen_by(config.start_from)
            if not seen:
                self._console.print(f"start_from {unknown(config.start_from)}")
            parts = replace(parts, test=tuple(ref for ref in parts.test if ref.content_hash not in seen))
        if not parts.train or not parts.test:
            raise UsageError(
                f"{folder}: {len(catalogue.usable)} usable objects are too few to train on some and test on others"
            )
        used = ObjectsUsed(
            folder=folder.name,
            train=parts.train,
            validation=parts.validation,
            test=parts.test,
            refused=catalogue.refused,
        )
        write_atomically(run.objects_file, used.model_dump_json(indent=2).encode())
        Store.create(run.store, self._setting(used, evaluation=False))
        Store.create(run.evaluation, self._setting(used, evaluation=True))
        counts = {name: len(refs) for name, refs in (("train", used.train), ("validation", used.validation))}
        counts |= {"test": len(used.test), "refused": len(used.refused)}
        self._say(f"objects: {', '.join(f'{count} {name}' for name, count in counts.items())}; reasons in objects.json")
        return counts

    def _setting(self, used: ObjectsUsed, *, evaluation: bool) -> Setting:
        config = self._config
        objects = used.test if evaluation else (*used.train, *used.validation)
        return make_setting(
            config.task_record,
            config.collection,
            kind="evaluation" if evaluation else "collection",
            seed=config.seed,
            objects=tuple(sorted(objects, key=lambda ref: ref.id)),
            evaluation=config.evaluation if evaluation else None,
        )

    def _evaluate(self) -> Mapping[str, Any]:
        """Evaluate every method on unseen objects with the last policy, and write the table."""
        run, rollouts, version = self._run, self._config.rollouts, self._config.alternations + 1
        evaluation = Evaluation(
            store=Store.open(run.evaluation),
            policies=Store.open(run.store).read_policy,
            version=version,
            rollouts=rollouts.total(rollouts.evaluation, len(run.objects_used().test)),
            per_shard=rollouts.per_shard,
            objects=run.objects_folder(),
            oracle=run.oracle,
            out=run.training("evaluate"),
            root=run.path,
        )
        collected = evaluation.execute(self._worker_group, self._say)
        return {**figures_of(collected), "policy": version}

    def _report(self) -> Mapping[str, Any]:
        """Write summary.json, affordance.png and report.html; no experiments, since a crash would be the driver's."""
        from cluster.reporting.report import write_report

        write_report(self._run, self._config, experiments=False, say=self._say)
        return {}

    def _say(self, line: str) -> None:
        self._console.print(plain(line), markup=False, soft_wrap=True)
