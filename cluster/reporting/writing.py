"""Assembles RUN/report.html from what a run left."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from cluster.config.campaign_config import CampaignConfig
from cluster.evaluation.tables import RESULTS_FILE
from cluster.evaluation.trials import first_trials, most_telling
from cluster.reporting.collecting import collection_section
from cluster.reporting.page import Page, Picture, Section, render, shortened
from cluster.reporting.results import Results, further_section, read_results, results_section, tiles
from cluster.reporting.training import training_section
from cluster.reporting.trial_sections import failures_section, proposals_section
from cluster.runs.run_folder import RunFolder, read_json
from cluster.runs.run_log import RunLog
from shared.errors import UsageError
from shared.io.files import make_folder, read_bounded, scratch_folder, write_atomically
from shared.policies.adaptation import Adapter
from shared.policies.policy import Policy
from shared.store import Store

MAX_PICTURE_BYTES = 4 << 20
MAX_FURTHER = 20
"""Evaluations beside the run's own that are shown."""


def write_page(run: RunFolder, config: CampaignConfig, *, experiments: bool, say: Callable[[str], None]) -> None:
    """Write RUN/report.html.

    Args:
        run: a run with summary.json.
        config: its configuration.
        experiments: whether to simulate other hidden facts, which takes some more seconds.
        say: receives a line for each step.

    Raises:
        StoreError: a file of the run is damaged or foreign.
    """
    summary = read_json(run.summary)
    store, evaluation = Store.open(run.store), Store.open(run.evaluation)
    policy = Policy.from_files(store.read_policy(store.policy_versions()[-1]))
    adapter, found = Adapter(policy), first_trials(evaluation)
    say("drawing tables, curves and clouds")
    novel = run.are_novel(run.objects_used().test)
    results = read_results(run.training("evaluate") / RESULTS_FILE, config.task, novel_categories=novel)
    further = _further(run)
    sections = [
        *([_picture(run.picture)] if run.picture.is_file() else []),
        results_section(results),
        *([further_section(further)] if further else []),
        proposals_section(most_telling(found, adapter), adapter),
        _hidden_facts(run, evaluation, adapter, say) if experiments else _not_tried(run),
        failures_section(found, adapter),
        training_section(run.trainings, list(summary["stage_seconds"])),
        collection_section(summary, store, RunLog(run.log)),
    ]
    page = Page(
        title=f"AdaAfford: {config.task}",
        subtitle=_subtitle(summary, config, results),
        tiles=tiles(results),
        sections=tuple(sections),
        facts=_facts(summary, run),
    )
    make_folder(run.path)
    write_atomically(run.page, render(page).encode())


def _further(run: RunFolder) -> list[tuple[str, Results]]:
    """What `adaafford evaluate` made of the run, by name, as far as it is finished."""
    found = []
    for path in sorted(run.evaluations.glob(f"*/{RESULTS_FILE}"))[:MAX_FURTHER]:
        novel = run.are_novel(Store.open(path.parent / "store").setting.objects)
        found.append((path.parent.name, read_results(path, novel_categories=novel)))
    return found


def _hidden_facts(run: RunFolder, evaluation: Store, adapter: Adapter, say: Callable[[str], None]) -> Section:
    # Only here, since they need the simulator.
    from cluster.reporting.counterfactuals import Counterfactuals, first_readable, hidden_facts_section, hinge_twins

    used, setting = run.objects_used(), evaluation.setting
    try:
        setting.dynamics.check_known()
        target = first_readable(run.objects_folder(), used.test, setting)
    except UsageError as error:
        say(str(error))
        return _not_tried(run)
    with scratch_folder("report") as folder:
        return hidden_facts_section(Counterfactuals(setting, adapter), target, hinge_twins(setting, folder), say)


def _not_tried(run: RunFolder) -> Section:
    name = run.path.resolve().name
    how = f"Made by `adaafford report {name}`, which simulates test objects with other hidden facts."
    return Section("hidden-facts", "Affordance under hidden facts", (how,))


def _picture(path: Path) -> Section:
    caption = "Affordance before and after each interaction, as the camera sees it."
    picture = Picture(read_bounded(path, MAX_PICTURE_BYTES), caption)
    return Section("glance", "At a glance", pictures=(picture,))


def _subtitle(summary: Mapping[str, Any], config: CampaignConfig, results: Results) -> str:
    objects = summary["objects"]
    minutes = summary["wall_seconds"] / 60
    workers = f"{config.workers} worker{'' if config.workers == 1 else 's'}"
    return (
        f"Affordance that adapts to one object after a few interactions: {summary['interactions']:,} interactions with "
        f"{len(objects['train'])} objects, evaluated on {results.objects} others, in {minutes:.0f} minutes "
        f"(seed {config.seed}, {workers})."
    )


def _facts(summary: Mapping[str, Any], run: RunFolder) -> tuple[tuple[str, str], ...]:
    return (
        ("run", run.path.resolve().name),
        ("objects", shortened(summary["objects"]["folder"])),
        ("store digest", summary["store_digest"]),
        ("software", _versions(summary["software"])),
        *(("earlier software", _versions(each)) for each in summary["earlier_software"]),
    )


def _versions(software: Mapping[str, str]) -> str:
    return ", ".join(f"{name} {version}" for name, version in software.items())
