"""The campaign: the alternation of collection and training as a list of stages over one folder.

    objects, collect-random, train-prior,
    train-aap-1, train-aip-1, publish-1,        (a run that starts from a policy has `adopt` for the three trainings)
    collect-aip-1, train-aap-2, train-aip-2, publish-2, ...
    (before the last publication train-where2act-interaction, train-where2act-adaptation, where they are evaluated)
    evaluate, report

The same live workers serve every collection round; each round's policy reaches them by version.
"""

import sys
from collections.abc import Mapping
from contextlib import closing
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from rich.console import Console

from cluster.adoption import fit_to_start_from, seen_by, unknown
from cluster.collection import collect
from cluster.configuration import CampaignConfig
from cluster.evaluation import Evaluation, figures_of
from cluster.fleet import Fleet, make_worker
from cluster.ledger import Ledger
from cluster.locking import only_driver
from cluster.objects import lists_of, objects_for, split_as_told
from cluster.run_folder import ObjectsUsed, RunFolder
from cluster.session import FleetMaker, fleets
from cluster.stages import Stage, run_stages
from cluster.training import Trainer
from collector.setting import make_setting, packages_used
from shared.errors import UsageError
from shared.files import write_atomically
from shared.methods import baselines_of
from shared.plain import plain
from shared.plan import Plan, Setting
from shared.store import Store
from shared.store.provenance import changed_versions, software_versions


class Crew:
    """The live fleet: one at a time, since each worker holds a CPU; kept as long as the store stays the same."""

    def __init__(self, make_fleet: FleetMaker) -> None:
        self._make_fleet = make_fleet
        self._fleet: Fleet | None = None
        self._of: tuple[Path, Path] | None = None

    def for_store(self, store: Store, objects: Path) -> Fleet:
        """The fleet whose workers write to `store`."""
        if self._fleet is None or self._of != (store.path, objects):
            self.dismiss()
            self._fleet = self._make_fleet(partial(make_worker, store.path, objects), store.underway)
            self._of = store.path, objects
        return self._fleet

    def dismiss(self) -> None:
        """End the workers."""
        if self._fleet is not None:
            self._fleet.close()
        self._fleet = None


class Campaign:
    """One run, from nothing or from wherever it was stopped to its report."""

    def __init__(self, run: RunFolder, config: CampaignConfig) -> None:
        self._run = run
        self._config = config
        self._console = Console(file=sys.stderr, highlight=False)
        self._trainer = Trainer(run, config, self._say)

    def execute(self) -> None:
        """Do what is left to do.

        Raises:
            AdaAffordError: a stage cannot go on; what was done stays done.
        """
        config = self._config
        with only_driver(self._run.path), closing(self._trainer):
            ledger = Ledger(self._run.log)
            ledger.note("attempt", workers=config.workers, software=software_versions())
            with fleets(config.workers, config.limits, config.ray_address) as make_fleet:
                stages = self.stages(Crew(make_fleet))
                changed = changed_versions(self._run.begun_with())
                if changed and any(stage.name not in ledger.finished for stage in stages):
                    self._say(f"begun with other software: {changed}; what is made from here on may differ by it")
                run_stages(stages, ledger, self._say)
            from cluster.report import print_report

            print_report(self._run)

    def stages(self, crew: Crew) -> list[Stage]:
        """All stages, in order."""
        trainer = self._trainer
        stages = [
            Stage("objects", self._choose_objects),
            Stage("collect-random", partial(self._collect, crew, "random", 0, self._config.rollouts.random)),
            Stage("adopt", trainer.adopt) if trainer.adopts else Stage("train-prior", trainer.prior),
        ]
        final = self._config.alternations + 1
        for version in range(1, final + 1):
            if version > 1:
                count = self._config.rollouts.aip
                stages.append(
                    Stage(f"collect-aip-{version - 1}", partial(self._collect, crew, "aip", version - 1, count))
                )
            last = trainer.left_by(version)
            if version > 1 or not trainer.adopts:
                stages += [
                    Stage(f"train-aap-{version}", partial(trainer.aap, version)),
                    Stage(f"train-aip-{version}", partial(trainer.aip, version)),
                ]
            for name in baselines_of(self._config.evaluation.methods) if version == final else ():
                stages.append(Stage(f"train-{name}", partial(trainer.baseline, name, last)))
                last = name
            stages.append(Stage(f"publish-{version}", partial(trainer.publish, version, last)))
        return [*stages, Stage("evaluate", partial(self._evaluate, crew, final)), Stage("report", self._report)]

    def _choose_objects(self) -> Mapping[str, Any]:
        """Decide which objects are trained on and which are kept for the end, and make both stores."""
        run, config = self._run, self._config
        task = config.task_record
        packages_used(task, config.collection)  # What cannot be found is refused before any object is read.
        per_category = config.procedural.per_category
        built_in, lists = run.generated_objects.resolve(), lists_of(config.splits)
        catalogue, folder = objects_for(task, config, built_in, per_category, config.seed, lists)
        parts = split_as_told((entry.ref for entry in catalogue.usable), config.splits, config.seed)
        if config.start_from is not None:
            fit_to_start_from(config.start_from, config.task)
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

    def _collect(self, crew: Crew, proposer: str, version: int, rollouts: int) -> Mapping[str, Any]:
        """One collection round."""
        store, folder = Store.open(self._run.store), self._run.objects_folder()
        plan = Plan(setting=store.setting, proposer=proposer, policy_version=version)
        open_fleet = partial(crew.for_store, store, folder)
        with store.only_driver():
            wanted = self._config.rollouts.total(rollouts, len(store.setting.objects))
            collected = collect(store, plan, wanted, self._config.rollouts.per_shard, open_fleet, folder)
        return figures_of(collected)

    def _evaluate(self, crew: Crew, version: int) -> Mapping[str, Any]:
        """Try every method on unseen objects with the last policy, and write the table."""
        run, rollouts = self._run, self._config.rollouts
        evaluation = Evaluation(
            store=Store.open(run.evaluation),
            policies=Store.open(run.store),
            version=version,
            rollouts=rollouts.total(rollouts.evaluation, len(run.objects_used().test)),
            per_shard=rollouts.per_shard,
            objects=run.objects_folder(),
            oracle=run.oracle,
            out=run.training("evaluate"),
        )
        open_fleet = partial(crew.for_store, evaluation.store, evaluation.objects)
        collected = evaluation.execute(open_fleet, crew.dismiss, self._say)
        return {**figures_of(collected), "policy": version}

    def _report(self) -> Mapping[str, Any]:
        """Write summary.json, affordance.png and report.html; no experiments, since a crash would be the driver's."""
        from cluster.report import write_report

        write_report(self._run, self._config, experiments=False, say=self._say)
        return {}

    def _say(self, line: str) -> None:
        self._console.print(plain(line), markup=False, soft_wrap=True)
