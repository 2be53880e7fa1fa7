"""An evaluation by itself: of which policy, on which objects, and where the table goes."""

import glob
import hashlib
import re
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from adaafford.pretrained import load_policy
from cluster.config.campaign_config import CampaignConfig, EvaluateSettings
from cluster.config.objects import objects_for
from cluster.evaluation.evaluate import Evaluation
from cluster.evaluation.tables import MARKDOWN_FILE, RESULTS_FILE
from cluster.runs.run_folder import RunFolder, find
from cluster.runs.warm_start import folder_of, seen_by, unknown
from cluster.workers.session import CurrentWorkerGroup, worker_groups
from collector.setting import in_fidelity_of, make_setting
from shared.config import PANDA, CollectionConfig
from shared.errors import UsageError
from shared.io.text import plain
from shared.plan import EvaluationConfig, ObjectRef, Setting
from shared.policies.methods import METHODS, MethodName
from shared.policies.policy import POLICY_FILE, WEIGHTS_FILE, Policy
from shared.store import Store
from shared.tasks import Task, task_named

EVALUATIONS = Path("evaluations")
"""Where tables of policies without a run go, unless a folder is named."""
ONLY_VERSION = 1
"""What trials of a policy without a run call it."""


@dataclass(frozen=True, slots=True)
class _Subject:
    """A policy that is evaluated.

    Attributes:
        policy: it.
        files: reads the files of a version.
        version: its own.
        methods: those that can be compared.
        collection: how its trials are seen and simulated.
        oracle: folder that may hold the oracle which taught it.
        root: the run's folder; None: it is without one.
        evaluations: folder of tables, unless one is named.
        label: what a folder there calls the policy.
        identity: what tells it from other policies that have the label.
    """

    policy: Policy
    files: Callable[[int], Mapping[str, bytes]]
    version: int
    methods: tuple[MethodName, ...]
    collection: CollectionConfig
    oracle: Path
    root: Path | None
    evaluations: Path
    label: str
    identity: str


def evaluate_run(path: Path, settings: EvaluateSettings, out: Path | None) -> None:
    """Evaluate a policy of the run in `path`, and print the table.

    Raises:
        AdaAffordError: the run has no such policy, the objects or methods do not suit, or a worker failed.
    """
    run, config = find(path)
    if settings.collection != CollectionConfig():
        raise UsageError("a run is evaluated on what it was trained on; --collection settings are for --policy")
    policies, used = Store.open(run.store), run.objects_used()
    version = _version(run, policies, settings.policy_version)
    policy = Policy.from_files(policies.read_policy(version))
    trained = config.task_record
    task = _task(trained, trained.terms(config.collection).primitive, settings, config.collection)
    if settings.objects is None:
        tested = frozenset(used.test)
        refs, folder = _objects(task, settings, run.objects_folder(), tested.__contains__)
    else:
        # By content: the same object may lie in two folders, under two names.
        seen = seen_by(str(run.path))
        refs, folder = _objects(task, settings, settings.objects, lambda ref: ref.content_hash not in seen)
    subject = _Subject(
        policy=policy,
        files=policies.read_policy,
        version=version,
        methods=_possible_methods(policy),
        collection=config.collection,
        oracle=run.oracle,
        root=Path(policies.where).parent,
        evaluations=run.evaluations,
        label=f"v{version}",
        identity=str(version),
    )
    _evaluate(subject, task, refs, folder, settings, config.seed, out)


def evaluate_without_run(source: str, settings: EvaluateSettings, out: Path | None) -> None:
    """Evaluate the policy of a name or place, and print the table.

    Args:
        source: as `load_policy` takes it; of a run, this is `evaluate_run`.
        settings: must name a folder of objects.
        out: folder of the table; None: one below `EVALUATIONS`.

    Raises:
        AdaAffordError: there is none, the objects or methods do not suit, or a worker failed.
    """
    place = folder_of(source)
    # What a training leaves beside a policy has the name of a run's configuration.
    if not (place / POLICY_FILE).is_file() and RunFolder(Path(source)).config.is_file():
        evaluate_run(Path(source), settings, out)
        return
    policy = load_policy(source)
    if settings.policy_version is not None:
        raise UsageError(f"--policy {source} is one policy; --policy-version is for --run")
    if settings.objects is None:
        raise UsageError(f"--policy {source} brings no test objects; name a folder with --objects")
    methods = tuple(name for name in _possible_methods(policy) if METHODS.get(name).version is None)
    for name in settings.methods:
        if METHODS.get(name).version is not None:
            raise UsageError(f"method '{name}' uses an earlier policy of a run; name the run with --run")
    if not methods:
        raise UsageError(f"--policy {source}: none of its networks is trained; name a trained policy")
    if settings.task is not None and policy.task_record is None:
        # A file defined the task of an older policy; only its user can tell whether the two agree.
        task = settings.task_record
    else:
        trained = policy.task_record or task_named(policy.task)
        task = _task(trained, trained.primitive, settings, settings.collection)
    if not (seen := seen_by(source)):
        Console(file=sys.stderr, highlight=False).print(f"policy {unknown(source)}", markup=False, soft_wrap=True)
    refs, folder = _objects(task, settings, settings.objects, lambda ref: ref.content_hash not in seen)
    files, collection = policy.to_files(), settings.collection
    if collection.gripper == PANDA:  # The default, which gives way to the hand that the policy knows.
        collection = collection.model_copy(update={"gripper": policy.gripper})
    subject = _Subject(
        policy=policy,
        files=lambda version: files,
        version=ONLY_VERSION,
        methods=methods,
        collection=policy.collection_for(collection),
        oracle=place,
        root=None,
        evaluations=EVALUATIONS,
        label=re.sub(r"[^A-Za-z0-9._-]", "_", place.name)[:100] or "policy",
        identity=hashlib.sha256(files[WEIGHTS_FILE]).hexdigest(),
    )
    _evaluate(subject, task, refs, folder, settings, CampaignConfig().seed, out)


def _evaluate(
    subject: _Subject,
    task: Task,
    refs: tuple[ObjectRef, ...],
    folder: Path,
    settings: EvaluateSettings,
    seed: int,
    out: Path | None,
) -> None:
    """Do what is left of the trials on objects of a folder, and print the table."""
    place = None if out is None else str(out / "store")
    setting = make_setting(
        task,
        subject.collection if place is None else in_fidelity_of(place, Store.begun_with(place), subject.collection),
        kind="evaluation",
        seed=seed if settings.seed is None else settings.seed,
        objects=refs,
        evaluation=EvaluationConfig(
            methods=tuple(dict.fromkeys(settings.methods)) or subject.methods,
            budgets=tuple(sorted(set(settings.budgets))),
            queries=settings.queries,
            exploit_share=settings.exploit_share,
            repeats=settings.repeats,
        ),
    )
    if out is None:
        out = _default_out(subject.evaluations, subject.label, subject.identity, setting, folder)
    evaluation = Evaluation(
        store=Store.create(out / "store", setting),
        policies=subject.files,
        version=subject.version,
        rollouts=settings.trials * len(refs),
        per_shard=settings.per_shard,
        objects=folder,
        oracle=subject.oracle,
        out=out,
        root=out if subject.root is None else subject.root,
    )
    _execute(evaluation, settings)
    for line in (out / MARKDOWN_FILE).read_text(encoding="utf-8").splitlines():
        print(plain(line))
    print(f"\n{out / RESULTS_FILE}")


def _execute(evaluation: Evaluation, settings: EvaluateSettings) -> None:
    console = Console(file=sys.stderr, highlight=False)
    with worker_groups(settings.workers, settings.limits, settings.ray_address) as make_worker_group:
        evaluation.execute(
            CurrentWorkerGroup(make_worker_group), lambda line: console.print(line, markup=False, soft_wrap=True)
        )


def _version(run: RunFolder, policies: Store, wanted: int | None) -> int:
    known = policies.policy_versions()
    if not known:
        raise UsageError(f"{run.path}: has published no policy yet; finish it with `adaafford resume {run.path}`")
    return known[-1] if wanted is None else wanted


def _task(trained: Task, primitive: str, settings: EvaluateSettings, collection: CollectionConfig) -> Task:
    """The task to evaluate on.

    Raises:
        UsageError: it needs another primitive than `primitive`, which is all that the networks know.
    """
    task = trained if settings.task is None else settings.task_record
    if (needed := task.terms(collection).primitive) != primitive:
        raise UsageError(
            f"the policy is trained to {primitive} (task '{trained.name}'), and task '{task.name}' needs {needed}; "
            "name a task of the same primitive"
        )
    return task


def _objects(
    task: Task, settings: EvaluateSettings, folder: Path, allowed: Callable[[ObjectRef], bool]
) -> tuple[tuple[ObjectRef, ...], Path]:
    """The objects of a folder that suit the task, are selected and may be tested on; and their folder.

    Raises:
        UsageError: none is left.
    """
    selection = settings.model_copy(update={"objects": folder})
    catalogue, folder = objects_for(task, selection, folder, per_category=0, seed=0)
    refs = {entry.ref for entry in catalogue.usable if allowed(entry.ref)}
    if not refs:
        raise UsageError(f"{folder}: no object suits task '{task.name}' and was not trained on; name other objects")
    return tuple(sorted(refs, key=lambda ref: ref.id)), folder


def _possible_methods(policy: Policy) -> tuple[MethodName, ...]:
    """The methods whose networks are trained, without those that somebody has to name."""
    known = {name: METHODS.get(name) for name in METHODS.names()}
    return tuple(
        name for name, method in known.items() if policy.trained.issuperset(method.modules) and not method.reference
    )


def _default_out(evaluations: Path, label: str, identity: str, setting: Setting, folder: Path) -> Path:
    """A folder that other settings do not share, and people can tell apart; the same after the objects have moved."""
    digest = hashlib.sha256(f"{identity} {setting.model_dump_json()}".encode()).hexdigest()
    begins, ends = f"{setting.task}-", f"-{label}-{digest[:8]}"
    begun = sorted(evaluations.glob(f"{begins}*{glob.escape(ends)}"))
    return begun[0] if begun else evaluations / f"{begins}{folder.name or 'objects'}{ends}"
