"""An evaluation of a run by itself: which of its policies, on which objects, and where the table goes."""

import hashlib
import sys
from pathlib import Path

from rich.console import Console

from cluster.config.campaign_config import CampaignConfig
from cluster.config.evaluation_settings import EvaluateSettings
from cluster.config.objects import objects_for
from cluster.evaluation.evaluate import Evaluation
from cluster.evaluation.tables import MARKDOWN_FILE, RESULTS_FILE
from cluster.runs.run_folder import ObjectsUsed, RunFolder, find
from cluster.runs.warm_start import seen_by
from cluster.workers.session import Crew, worker_groups
from collector.setting import make_setting
from collector.watchdog import Limits
from shared.errors import UsageError
from shared.io.text import plain
from shared.plan import EvaluationConfig, ObjectRef, Setting
from shared.policies.methods import METHODS, MethodName
from shared.policies.policy import Policy
from shared.store import Store
from shared.tasks import Task


def evaluate_run(path: Path, settings: EvaluateSettings, out: Path | None) -> None:
    """Evaluate a policy of the run in `path`, and print the table.

    Raises:
        AdaAffordError: the run has no such policy, the objects or methods do not suit, or a worker failed.
    """
    run, config = find(path)
    policies, used = Store.open(run.store), run.objects_used()
    version = _version(run, policies, settings.policy)
    policy = Policy.from_files(policies.read_policy(version))
    task = _task(config, settings)
    refs, folder = _objects(task, settings, run, used)
    setting = make_setting(
        task,
        config.collection,
        kind="evaluation",
        seed=config.seed if settings.seed is None else settings.seed,
        objects=refs,
        evaluation=EvaluationConfig(
            methods=tuple(dict.fromkeys(settings.methods)) or _possible_methods(policy),
            budgets=tuple(sorted(set(settings.budgets))),
            queries=settings.queries,
        ),
    )
    out = out if out is not None else _default_out(run, setting, folder, version)
    evaluation = Evaluation(
        store=Store.create(out / "store", setting),
        policies=policies,
        version=version,
        rollouts=settings.trials * len(refs),
        per_shard=settings.per_shard,
        objects=folder,
        oracle=run.oracle,
        out=out,
    )
    _execute(evaluation, settings)
    for line in (out / MARKDOWN_FILE).read_text(encoding="utf-8").splitlines():
        print(plain(line))
    print(f"\n{out / RESULTS_FILE}")


def _execute(evaluation: Evaluation, settings: EvaluateSettings) -> None:
    console = Console(file=sys.stderr, highlight=False)
    limits = Limits(settings.rollout_limit_s, settings.memory_limit_mb)
    with worker_groups(settings.workers, limits, settings.ray_address) as make_worker_group:
        evaluation.execute(Crew(make_worker_group), lambda line: console.print(line, markup=False, soft_wrap=True))


def _version(run: RunFolder, policies: Store, wanted: int | None) -> int:
    known = policies.policy_versions()
    if not known:
        raise UsageError(f"{run.path}: has published no policy yet; finish it with `adaafford resume {run.path}`")
    return known[-1] if wanted is None else wanted


def _task(config: CampaignConfig, settings: EvaluateSettings) -> Task:
    """The task to evaluate on; the networks were trained for one primitive and know no other."""
    trained = config.task_record
    task = trained if settings.task is None else settings.task_record
    if task.primitive != trained.primitive:
        raise UsageError(
            f"the run is trained to {trained.primitive} (task '{trained.name}'), and task '{task.name}' needs "
            f"{task.primitive}; name a task of the same primitive"
        )
    return task


def _objects(
    task: Task, settings: EvaluateSettings, run: RunFolder, used: ObjectsUsed
) -> tuple[tuple[ObjectRef, ...], Path]:
    """The run's test objects, or all of another folder that suit the task and were not trained on; and their folder.

    Args:
        task: what is evaluated.
        settings: may name another folder.
        run: whose policy it is.
        used: by the run.

    Raises:
        UsageError: none is left.
    """
    own = run.objects_folder() if settings.objects is None else settings.objects
    selection = settings.model_copy(update={"objects": own})
    catalogue, folder = objects_for(task, selection, own, per_category=0, seed=0)
    refs = {entry.ref for entry in catalogue.usable}
    if settings.objects is None:
        refs &= set(used.test)
    else:
        # By content: the same object may lie in two folders, under two names.
        seen = seen_by(str(run.path))
        refs = {ref for ref in refs if ref.content_hash not in seen}
    if not refs:
        raise UsageError(f"{folder}: no object suits task '{task.name}' and was not trained on; name other objects")
    return tuple(sorted(refs, key=lambda ref: ref.id)), folder


def _possible_methods(policy: Policy) -> tuple[MethodName, ...]:
    """The methods whose networks are trained."""
    return tuple(name for name in METHODS.names() if policy.trained.issuperset(METHODS.get(name).modules))


def _default_out(run: RunFolder, setting: Setting, folder: Path, version: int) -> Path:
    """A folder that other settings do not share, and people can tell apart; the same after the objects have moved."""
    digest = hashlib.sha256(f"{version} {setting.model_dump_json()}".encode()).hexdigest()
    begun = sorted(run.evaluations.glob(f"{setting.task}-*-v{version}-{digest[:8]}"))
    return begun[0] if begun else run.evaluations / f"{setting.task}-{folder.name or 'objects'}-v{version}-{digest[:8]}"
