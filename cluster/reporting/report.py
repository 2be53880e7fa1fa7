"""The report of a run: summary.json for programs, a table and a page for people, one picture."""

import json
from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from cluster.config.campaign_config import CampaignConfig
from cluster.evaluation.tables import RESULTS_FILE
from cluster.reporting.collecting import collection_section
from cluster.reporting.page import Page, Picture, Section, render, shortened
from cluster.reporting.picture import draw_adaptation
from cluster.reporting.results import Results, further_section, read_results, results_section, tiles
from cluster.reporting.training import training_section
from cluster.reporting.trial_sections import failures_section, first_trials, most_telling, proposals_section
from cluster.runs.run_folder import RunFolder, read_json
from cluster.runs.run_log import RunLog
from shared.errors import UsageError
from shared.io.files import read_bounded, scratch_folder, write_atomically
from shared.policies.adaptation import Adapter
from shared.policies.policy import Policy
from shared.software import software_versions
from shared.store import Store
from shared.types import OutcomeKind

MAX_PICTURE_BYTES = 4 << 20
MAX_FURTHER = 20
"""Evaluations beside the run's own that are shown."""
MOTION_EDGES = (0.0, 1e-4, 1e-3, 1e-2, 3e-2, 0.1, 0.3, 1.0, 3.0, float("inf"))
"""Of the motion histogram, rad or length; 0.01 is the least that can be a success."""
_COLUMNS = ("object_category", "proposer", "policy_version", "outcome", "motion", "success")


def write_report(run: RunFolder, config: CampaignConfig, *, experiments: bool, say: Callable[[str], None]) -> None:
    """Write summary.json, affordance.png and report.html from the results of the run's stages.

    Args:
        run: a run that was evaluated.
        config: its configuration.
        experiments: whether to simulate other hidden facts for the page, which takes some more seconds.
        say: receives a line for each step.

    Raises:
        StoreError: a file of the run is damaged or foreign.
    """
    run_log, store = RunLog(run.log), Store.open(run.store)
    used = run.objects_used()
    versions = store.policy_versions()
    summary = {
        "task": config.task,
        "seed": config.seed,
        "rows": _rows(run),
        **collection_figures(store),
        "interactions_per_core_second": _speed(run_log),
        "policy_versions": [0, *versions],
        "stage_seconds": {name: round(seconds, 1) for name, seconds in run_log.seconds.items()},
        "wall_seconds": round(sum(run_log.seconds.values()), 1),
        "workers": config.workers,
        "objects": {
            # The name alone, since results are published; older runs have a whole path.
            "folder": Path(used.folder).name,
            **{name: [ref.id for ref in getattr(used, name)] for name in ("train", "validation", "test")},
            "refused": [{"id": object_id, "reason": reason} for object_id, reason in used.refused],
        },
        "store_digest": store.digest(),
        "software": software_versions(),
        "earlier_software": _earlier_software(run, run_log),
    }
    write_atomically(run.summary, json.dumps(summary, indent=1, allow_nan=False).encode())
    evaluation, policy = Store.open(run.evaluation), Policy.from_files(store.read_policy(versions[-1]))
    draw_adaptation(evaluation, policy, run.picture)
    adapter, found = Adapter(policy), first_trials(evaluation)
    say("drawing tables, curves and clouds")
    novel = run.are_novel(used.test)
    results = read_results(run.training("evaluate") / RESULTS_FILE, config.task, novel_categories=novel)
    further = _further(run)
    sections = [
        *([_picture(run.picture)] if run.picture.is_file() else []),
        results_section(results),
        *([further_section(further)] if further else []),
        proposals_section(most_telling(found, adapter), adapter),
        _hidden_facts(run, evaluation, adapter, say) if experiments else _not_tried(run),
        failures_section(found, adapter),
        training_section(run.trainings, list(run_log.seconds)),
        collection_section(summary, store, run_log),
    ]
    page = Page(
        title=f"AdaAfford: {config.task}",
        subtitle=_subtitle(summary, config, results),
        tiles=tiles(results),
        sections=tuple(sections),
        facts=_facts(summary, run),
    )
    write_atomically(run.page, render(page).encode())


def _rows(run: RunFolder) -> list[dict[str, Any]]:
    rows = read_json(run.training("evaluate") / RESULTS_FILE)["rows"]
    assert isinstance(rows, list)
    return rows


def _earlier_software(run: RunFolder, run_log: RunLog) -> list[dict[str, str]]:
    """Other versions that made parts of the run, in the order of their attempts."""
    known = [run.begun_with(), *run_log.software]
    return [each for n, each in enumerate(known) if each and each != software_versions() and each not in known[:n]]


def _speed(run_log: RunLog) -> float | None:
    """Stored interactions for each second that a worker worked, over the collection rounds."""
    tallies = [run_log.result(name)["tally"] for name in run_log.finished if name.startswith("collect-")]
    interactions = sum(tally["interactions"] for tally in tallies)
    seconds = sum(tally["seconds"].get("total", 0.0) for tally in tallies)
    return round(interactions / seconds, 2) if seconds > 0 else None


def collection_figures(store: Store) -> dict[str, Any]:
    """What summary.json says of a store's interactions; those that infrastructure failed are counted, not judged."""
    table = store.interactions(_COLUMNS).to_pydict()
    rows = [dict(zip(table, values, strict=True)) for values in zip(*table.values(), strict=True)]
    labels = [row for row in rows if OutcomeKind(row["outcome"]).is_label]
    random = [row for row in labels if row["proposer"] == "random"]
    outcomes = Counter(row["outcome"] for row in rows)
    proposed = sorted({(row["policy_version"], row["proposer"]) for row in rows})
    return {
        "interactions": len(rows),
        "by_proposer": [
            {"proposer": name, "policy_version": version}
            | _rate([row for row in labels if (row["policy_version"], row["proposer"]) == (version, name)])
            for version, name in proposed
        ],
        "random_success_by_category": {
            category: _rate([row for row in random if row["object_category"] == category])
            for category in sorted({row["object_category"] for row in random})
        },
        "random_motion_histogram": _histogram([row["motion"] for row in random]),
        "outcomes": {name: {"count": n, "share": n / len(rows)} for name, n in sorted(outcomes.items())},
    }


def _rate(rows: list[dict[str, Any]]) -> dict[str, Any]:
    successes = sum(row["success"] for row in rows)
    rate = successes / len(rows) if rows else None
    return {"interactions": len(rows), "successes": successes, "success_rate": rate}


def _histogram(motions: list[float]) -> list[dict[str, Any]]:
    """Counts of motions in [low, high); JSON has no infinity, so the last `high` is null."""
    counts, _ = np.histogram(motions, MOTION_EDGES)
    highs = [high if np.isfinite(high) else None for high in MOTION_EDGES[1:]]
    return [
        {"low": low, "high": high, "count": int(count)}
        for low, high, count in zip(MOTION_EDGES[:-1], highs, counts, strict=True)
    ]


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
