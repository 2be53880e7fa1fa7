"""What was collected: base rates, how trials ended, what proposed them, where the time went, what was given up."""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import plotly.graph_objects as go
from plotly.subplots import make_subplots

from cluster.reporting.page import Cell, Drawing, Section, Table, plain, shortened
from cluster.reporting.style import ACCENT, SECOND, laid_out
from cluster.runs.run_log import RunLog
from shared.store import Store
from shared.store.layout import Quarantined
from shared.store.maintenance.info import quarantined_in

BAR_HEIGHT = 26
MAX_ROWS = 50
"""Of a table of quarantined rollouts, or of refused objects."""
CONFIDENCE_Z = 1.96

Summary = Mapping[str, Any]


def collection_section(summary: Summary, store: Store, run_log: RunLog) -> Section:
    """The statistics of a run's collection.

    Raises:
        StoreError: a manifest is damaged or foreign.
    """
    quarantined = quarantined_in(store.manifests())
    objects = summary["objects"]
    speed = summary["interactions_per_core_second"]
    lead = (
        f"{summary['interactions']:,} interactions"
        + ("" if speed is None else f", {speed:g} a second and core")
        + f"; {len(objects['train'])} objects to train on, {len(objects['validation'])} to validate, "
        f"{len(objects['test'])} to test, {len(objects['refused'])} refused; "
        f"policy versions {', '.join(map(str, summary['policy_versions']))} (0: no policy, random); "
        f"{len(quarantined)} rollouts quarantined.",
    )
    tables = [_quarantine(quarantined)] if quarantined else []
    if objects["refused"]:
        tables.append(_refused(objects["refused"]))
    drawings = (_rates(summary), _outcomes(summary), _seconds(summary, worker_seconds(run_log)))
    return Section("collection", "Collection", lead, tables=tuple(tables), drawings=drawings)


def wilson(successes: int, count: int) -> tuple[float, float]:
    """The 95% interval of Wilson for a share; (0, 1) where nothing was counted."""
    if not count:
        return 0.0, 1.0
    z2, share = CONFIDENCE_Z**2, successes / count
    middle = (share + z2 / (2 * count)) / (1 + z2 / count)
    half = CONFIDENCE_Z / (1 + z2 / count) * math.sqrt(share * (1 - share) / count + z2 / (4 * count * count))
    # At shares of 0 and 1 the limits are these very numbers, but for rounding.
    return max(0.0, min(middle - half, share)), min(1.0, max(middle + half, share))


def worker_seconds(run_log: RunLog) -> dict[str, float]:
    """Seconds of workers by stage over all collection rounds that recorded them."""
    spent: Counter[str] = Counter()
    for name in run_log.finished:
        if name.startswith("collect-"):
            spent.update(run_log.result(name)["tally"]["seconds"])
    spent.pop("total", None)
    return dict(spent)


def _rates(summary: Summary) -> Drawing:
    """Success rates by category, and by who proposed."""
    categories = summary["random_success_by_category"]
    proposers = {f"{each['proposer']} (policy {each['policy_version']})": each for each in summary["by_proposer"]}
    figure = make_subplots(
        1,
        2,
        subplot_titles=["random interactions, by category", "all interactions, by proposer"],
        horizontal_spacing=0.2,
    )
    for column, rates in enumerate((categories, proposers), start=1):
        names = list(rates)[::-1]
        counts = [(rates[name]["successes"], rates[name]["interactions"]) for name in names]
        shares = [done / made if made else 0.0 for done, made in counts]
        limits = [wilson(done, made) for done, made in counts]
        figure.add_trace(
            go.Bar(
                y=[plain(name) for name in names],
                x=[100 * share for share in shares],
                error_x={
                    "type": "data",
                    "array": [100 * (high - share) for share, (_, high) in zip(shares, limits, strict=True)],
                    "arrayminus": [100 * (share - low) for share, (low, _) in zip(shares, limits, strict=True)],
                    "thickness": 1,
                    "width": 4,
                },
                orientation="h",
                marker={"color": SECOND if column == 1 else ACCENT},
                customdata=[f"{done:,} of {made:,}" for done, made in counts],
                hovertemplate="%{x:.1f}%: %{customdata}<extra></extra>",
            ),
            1,
            column,
        )
    figure.update_xaxes(title_text="successful (%)", rangemode="tozero")
    bars = max(len(categories), len(proposers), 2)
    laid_out(figure, 130 + BAR_HEIGHT * bars, showlegend=False, bargap=0.35)
    return Drawing(figure, "Base rates with 95% intervals (Wilson's, over interactions).")


def _outcomes(summary: Summary) -> Drawing:
    """How trials ended, and how far parts moved."""
    outcomes = sorted(summary["outcomes"].items(), key=lambda item: item[1]["count"])
    bins = summary["random_motion_histogram"]
    figure = make_subplots(
        1, 2, subplot_titles=["how trials ended", "how far random trials moved the part"], horizontal_spacing=0.2
    )
    figure.add_trace(
        go.Bar(
            y=[plain(name) for name, _ in outcomes],
            x=[100 * each["share"] for _, each in outcomes],
            customdata=[each["count"] for _, each in outcomes],
            hovertemplate="%{x:.1f}%: %{customdata:,}<extra></extra>",
            orientation="h",
            marker={"color": SECOND},
        ),
        1,
        1,
    )
    figure.add_trace(
        go.Bar(
            x=[f"≥ {b['low']:g}" if b["high"] is None else f"{b['low']:g} to {b['high']:g}" for b in bins],
            y=[each["count"] for each in bins],
            marker={"color": [ACCENT if each["low"] >= 0.01 else "#c3c9d0" for each in bins]},
            hovertemplate="%{x}: %{y:,}<extra></extra>",
        ),
        1,
        2,
    )
    figure.update_xaxes(title_text="share of all trials (%)", row=1, col=1)
    figure.update_xaxes(title_text="motion (rad or length)", type="category", row=1, col=2)
    figure.update_yaxes(title_text="trials", row=1, col=2)
    laid_out(figure, max(300, 130 + BAR_HEIGHT * len(outcomes)), showlegend=False, bargap=0.3)
    return Drawing(
        figure, 'Motions in red are long enough to count as a success; "ok" means that the primitive ran to its end.'
    )


def _seconds(summary: Summary, workers: Mapping[str, float]) -> Drawing:
    """Where the wall time went."""
    stages = summary["stage_seconds"]
    figure = make_subplots(
        1, 2, subplot_titles=["wall time by stage (s)", "time of workers while collecting (s)"], horizontal_spacing=0.2
    )
    for column, spent in enumerate((stages, workers), start=1):
        names = list(spent)[::-1]
        figure.add_trace(
            go.Bar(
                y=[plain(name) for name in names],
                x=[spent[name] for name in names],
                orientation="h",
                marker={"color": [ACCENT if name.startswith("train") else SECOND for name in names]},
                text=[f"{spent[name]:,.0f}" for name in names],
                textposition="outside",
                cliponaxis=False,
                hovertemplate="%{x:,.1f} s<extra></extra>",
            ),
            1,
            column,
        )
    figure.update_xaxes(rangemode="tozero")
    bars = max(len(stages), len(workers), 2)
    laid_out(figure, 110 + BAR_HEIGHT * bars, showlegend=False, bargap=0.3, margin={"l": 60, "r": 60, "t": 40, "b": 40})
    return Drawing(figure, f"{summary['wall_seconds']:,.0f} s in all; training in red.")


def _quarantine(quarantined: Sequence[Quarantined]) -> Table:
    head = (Cell("rollout"), Cell("why", kind="name"), Cell("executes it alone", kind="name"))
    body = tuple(
        (Cell(str(each.rollout)), Cell(shortened(each.reason), kind="name"), Cell(each.command[:500], kind="name"))
        for each in quarantined[:MAX_ROWS]
    )
    return Table((head,), body, f"Quarantined rollouts: {len(quarantined)}, here {len(body)}", folded=True)


def _refused(refused: Sequence[Mapping[str, str]]) -> Table:
    head = (Cell("object", kind="name"), Cell("why it was refused", kind="name"))
    body = tuple(
        (Cell(shortened(each["id"]), kind="name"), Cell(shortened(each["reason"]), kind="name"))
        for each in refused[:MAX_ROWS]
    )
    return Table((head,), body, f"Refused objects: {len(refused)}, here {len(body)}", folded=True)
