"""A picture of `benchmarks.scaling`: what was measured, and where it leads."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks.scaling import Line

if TYPE_CHECKING:
    from matplotlib.axes import Axes

KINDS = {"guest": ("o", "actors that share processes"), "process": ("s", "an actor a process")}
NOW, THEN = "tab:blue", "tab:gray"


def draw(result: dict[str, Any], before: dict[str, Any] | None, path: Path) -> None:
    """Write a PNG file.

    Args:
        result: of the benchmark.
        before: an earlier one, whose worker groups are drawn beside.
        path: the file.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 7.2), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(2, 2)
    _cost(axes[0, 0], result, before)
    _memory(axes[0, 1], result)
    _load(axes[1, 0], result)
    _start(axes[1, 1], result)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)


def _cost(axes: "Axes", result: dict[str, Any], before: dict[str, Any] | None) -> None:
    for label, found, colour in (("", result, NOW), ("before: ", before, THEN)):
        for kind, (mark, words) in KINDS.items():
            points = [] if found is None else [each for each in found["fleets"] if each["kind"] == kind]
            if points:
                x, y = [each["actors"] for each in points], [each["driver_ms"] for each in points]
                axes.plot(
                    x, y, mark, color=colour, label=label + words, fillstyle="full" if kind == "guest" else "none"
                )
    for each in result["predictions"]:
        at = result["predicted_for"]["actors"], 1e3 * each["driver_load"] / each["shards_per_s"]
        axes.plot(*at, "*", color="tab:red", ms=10)
    axes.set(xscale="log", yscale="log", xlabel="actors", ylabel="driver, processor ms a shard")
    axes.set(title="Cost of a shard (stars: predicted)", ylim=(0.1, None))
    axes.legend(fontsize="small")


def _memory(axes: "Axes", result: dict[str, Any]) -> None:
    points = [each for each in result["fleets"] if each["kind"] == "guest"]
    actors = [each["actors"] for each in points]
    axes.plot(actors, [100 * each["ideal_share"] for each in points], "o-", color=NOW, label="of ideal throughput, %")
    axes.set(
        xscale="log", xlabel="actors", ylabel="% of actors / sleep time", ylim=(0, 105), title="Throughput, memory"
    )
    right = axes.twinx()
    memory = [each["memory_mb"] for each in points]
    right.plot(actors, memory, "^-", color="tab:green", label="memory of the driver, MB")
    right.set(ylabel="MB", ylim=(0, 1.4 * max(memory)))
    lines = [*axes.get_lines(), *right.get_lines()]
    axes.legend(lines, [str(line.get_label()) for line in lines], fontsize="small", loc="lower left")


def _load(axes: "Axes", result: dict[str, Any]) -> None:
    wish = result["predicted_for"]
    x = np.geomspace(10, 10 * wish["actors"], 100)
    for each in result["predictions"]:
        y = x * each["driver_load"] / wish["actors"]
        axes.plot(x, y, label=f"{each['per_shard']} rollouts a shard, {each['job_s']:.3g} s a job")
    axes.axhline(1, color="black", lw=0.8)
    axes.axvline(wish["actors"], color="tab:red", lw=0.8, ls=":")
    axes.set(xscale="log", yscale="log", xlabel="actors", ylabel="processors", ylim=(1e-3, 20))
    axes.set(title=f"Driver's load, predicted (actors of {wish['interactions_per_s']:g} interactions/s)")
    axes.legend(fontsize="small")


def _start(axes: "Axes", result: dict[str, Any]) -> None:
    line, wish = Line(**result["start_s_by_shards"]), result["predicted_for"]
    shards = [each["shards"] for each in result["stores"]]
    axes.plot(shards, [each["start_s"] for each in result["stores"]], "o", color=NOW, label="start of a driver, s")
    most = max(each["shards"] for each in result["predictions"])
    x = np.geomspace(shards[0], most, 50)
    axes.plot(x, [line(each) for each in x], "-", color=NOW, alpha=0.6)
    for each in result["predictions"]:
        axes.plot(each["shards"], each["start_s"], "*", color="tab:red", ms=11)
        axes.annotate(f"{each['per_shard']} a shard ", (each["shards"], each["start_s"]), ha="right", fontsize="small")
    commits = [each["commit_ms"] / 1e3 for each in result["stores"]]
    axes.plot(shards, commits, "v--", color="tab:orange", label="commit of one shard more, s")
    axes.set(xscale="log", yscale="log", xlabel="shards of the store", ylabel="s")
    axes.set(title=f"Listing; stars: {wish['interactions']:.0e} interactions".replace("e+0", "e"))
    axes.legend(fontsize="small", loc="upper left")
