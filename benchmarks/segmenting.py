"""How well is the movable part of a raw scan found? Objects stand on a floor, among other things, and the camera errs.

For each scene, `auto` is the intersection over union (IoU) of the most confident part with the physical part that it
is on; 0 where none is found. `turning` is the same of the part that most probably turns, with the physical parts that
turn, in scenes that show any. `each part` is the IoU of each physical part that is seen with the found part that fits
it best. All points of the scan count.
"""

import time
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from statistics import mean, median
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field

from adaafford.histories import TriedOutcome
from adaafford.parts import AUTO, bundled_segmenter, read_segmenter
from adaafford.pretrained import load_policy
from adaafford.scans import Scan, npz_of
from adaafford.sessions import Session, SessionFiles
from benchmarks.script import main
from cluster.cli.commands.bench import BenchSettings
from collector.objects.articulation import ArticulatedObject
from collector.objects.catalogue import load, of_categories, scan
from collector.scenes import RawScan, random_scan
from shared import seeds
from shared.errors import UsageError
from shared.io.files import make_folder
from shared.progress import Progress
from shared.segmentation.scenes import MOVABLE, Kind
from shared.segmentation.segmenter import Segmentation, Segmenter
from shared.tasks import expanded

SEEN_POINTS = 150
"""A part of which fewer points are scanned is not asked for."""
WORST = 8
POLICIES = {"push-faucet": "push-faucet"}
"""Bundled policies by task; `pull-closed-door` for all other tasks."""


class SegmentingSettings(BenchSettings):
    """Measure how well movable parts are found in raw scans."""

    scenes: int = Field(60, ge=1, le=100_000)
    """Number of scenes; each object in turn."""
    network: Path | None = None
    """The --out of `adaafford train segmentation`; default: the bundled network."""
    noise: float = Field(1.0, ge=0, le=10)
    """Strength of the errors of the camera."""
    steps: int = Field(0, ge=0, le=1000)
    """Time so many steps of a session with raw scans, too: the files are read, the part is found, an action is proposed
    by a bundled policy of the task, and the affordance and the parts are written."""
    pictures: Path | None = None
    """Folder for pictures of the scenes: what was measured, what is true, and what was found."""


@dataclass(frozen=True, slots=True)
class Found:
    """What came of one scene.

    Attributes:
        object: its id.
        category: its category.
        auto: IoU of the most confident part.
        turning: IoU of the part that most probably turns; None where no part that turns is seen.
        each: IoU of each physical part.
        seconds: of the segmentation.
    """

    object: str
    category: str
    auto: float
    turning: float | None
    each: tuple[float, ...]
    seconds: float


def measure(command: SegmentingSettings) -> dict[str, Any]:
    """Measure, and print a table."""
    segmenter = bundled_segmenter() if command.network is None else read_segmenter(command.network)
    if command.objects is None:
        raise UsageError("--objects: name a folder of objects that the network was not trained on")
    usable = of_categories(scan(command.objects), expanded(command.categories)).usable
    if not usable:
        raise UsageError(f"{command.objects}: no usable object of these categories")
    if command.pictures is not None:
        make_folder(command.pictures)
    found: list[Found] = []
    with Progress("scenes", command.scenes) as progress:
        for number in range(command.scenes):
            target = load(usable[number % len(usable)])
            if (seen := _scene(target, command, number)) is not None:
                picture = None if command.pictures is None else command.pictures / f"{number:03d}-{target.ref.id}.png"
                found.append(_measured(segmenter, target, seen, picture))
            progress.show(number + 1)
    result = _table(found)
    if command.steps:
        result |= _timed_steps(command, load(usable[0]))
    worst = sorted(found, key=lambda one: one.auto)[:WORST]
    print("worst: " + ", ".join(f"{one.object} ({one.category}) {one.auto:.2f}" for one in worst))
    return result | {"worst": [[one.object, one.category, round(one.auto, 3)] for one in worst], "noise": command.noise}


def _scene(target: ArticulatedObject, command: SegmentingSettings, number: int) -> RawScan | None:
    """A scan that shows a part; None where several draws do not."""
    for attempt in range(5):
        seen = random_scan(
            target, (command.noise, command.noise), seeds.generator(command.seed, "bench", number, attempt)
        )
        if _true_parts(seen):
            return seen
    return None


def _true_parts(seen: RawScan) -> list[NDArray[np.bool_]]:
    movable = np.isin(seen.kinds, MOVABLE)
    parts = [movable & (seen.image.bodies == body) for body in np.unique(seen.image.bodies[movable])]
    return [part for part in parts if part.sum() >= SEEN_POINTS]


def _measured(segmenter: Segmenter, target: ArticulatedObject, seen: RawScan, picture: Path | None) -> Found:
    begun = time.perf_counter()
    try:
        found = segmenter.segment(seen.image.points, seen.world_from_camera[:3, 3])
    except UsageError:
        found = Segmentation(np.zeros(0, dtype=np.int64), ())
    seconds = time.perf_counter() - begun
    guessed = []
    for part in found.parts:
        mask = np.zeros(len(seen.kinds), dtype=bool)
        mask[part.points] = True
        guessed.append(mask)
    true = _true_parts(seen)
    each = tuple(max((_iou(one, guess) for guess in guessed), default=0.0) for one in true)
    auto = max((_iou(one, guessed[0]) for one in true), default=0.0) if guessed else 0.0
    turning = None
    if turns := [one for one in true if seen.kinds[one][0] == Kind.TURNING]:
        first = max(range(len(guessed)), key=lambda n: found.parts[n].confidences[Kind.TURNING], default=None)
        turning = 0.0 if first is None else max(_iou(one, guessed[first]) for one in turns)
    if picture is not None:
        _draw(picture, seen, found, f"{target.ref.id} {target.ref.category}: auto {auto:.2f}")
    return Found(target.ref.id, target.ref.category, auto, turning, each, seconds)


def _iou(one: NDArray[np.bool_], other: NDArray[np.bool_]) -> float:
    return float((one & other).sum() / max((one | other).sum(), 1))


def _table(found: list[Found]) -> dict[str, Any]:
    by_category: dict[str, list[Found]] = defaultdict(list)
    for one in found:
        by_category[one.category].append(one)
    print(f"{len(found)} scenes, IoU of movable parts")
    print(f"  {'category':<18}{'scenes':>7}{'auto':>7}{'turning':>9}{'each part':>11}{'auto > 0.5':>12}")
    rows = {}
    for category, ones in [*sorted(by_category.items()), ("all", found)]:
        each = [iou for one in ones for iou in one.each]
        turning = [one.turning for one in ones if one.turning is not None]
        row = {
            "scenes": len(ones),
            "auto": round(mean(one.auto for one in ones), 3),
            "turning": round(mean(turning), 3) if turning else None,
            "each_part": round(mean(each), 3),
            "auto_above_half": round(mean(one.auto > 0.5 for one in ones), 3),
        }
        rows[category] = row
        print(
            f"  {category:<18}{row['scenes']:>7}{row['auto']:>7.2f}"
            f"{'-' if not turning else format(row['turning'], '.2f'):>9}{row['each_part']:>11.2f}"
            f"{row['auto_above_half']:>12.2f}"
        )
    milliseconds = round(1000 * median(one.seconds for one in found), 1)
    print(f"{milliseconds:.0f} ms a scan (median), {torch.get_num_threads()} threads")
    return {"categories": rows, "milliseconds": milliseconds, "threads": torch.get_num_threads()}


def _timed_steps(command: SegmentingSettings, target: ArticulatedObject) -> dict[str, Any]:
    """Duration of a step of a session, in wall time and in processor time."""
    with TemporaryDirectory() as name:
        folder = Path(name)
        policy = load_policy(POLICIES.get(command.task, "pull-closed-door"))
        session = Session(policy, SessionFiles(folder / "history.json", folder / "heatmap.ply"), part=AUTO)
        wall, processor = [], []
        for number in range(command.steps + 1):
            seen = random_scan(target, (command.noise, command.noise), seeds.generator(command.seed, "bench/steps", 0))
            camera = (*map(float, seen.world_from_camera[:3, 3]),)
            path = folder / f"scan-{number}.npz"
            # Another scan of the same state: nothing is remembered of it.
            places = seen.image.points.astype(np.float32).astype(np.float64) + 1e-4 * number
            path.write_bytes(npz_of(Scan(places, camera=(camera[0], camera[1], camera[2]))))
            begun, spent = time.perf_counter(), time.process_time()
            session.step(path, None if number == 0 else TriedOutcome(motion=0.0), number or None)
            wall.append(time.perf_counter() - begun)
            processor.append(time.process_time() - spent)
    figures = {
        "step_milliseconds": round(1000 * median(wall[1:]), 1),
        "step_processor_milliseconds": round(1000 * median(processor[1:]), 1),
    }
    print(
        f"{figures['step_milliseconds']:.0f} ms a step (median of {command.steps}), of them "
        f"{figures['step_processor_milliseconds']:.0f} ms of the processor; the files are read and written in it"
    )
    return figures


def _draw(path: Path, seen: RawScan, found: Segmentation, title: str) -> None:
    """Depth, true kinds and found parts, as the camera saw them."""
    from matplotlib import colormaps
    from matplotlib.figure import Figure

    size = int(np.ceil(np.sqrt(seen.image.pixels.max() + 1)))
    size = max(size, 448)

    def image(colours: NDArray[np.float64]) -> NDArray[np.float64]:
        whole = np.zeros((size * size, 3))
        whole[seen.image.pixels] = colours
        return whole.reshape(size, size, 3)

    towards = seen.world_from_camera[:3, 3] - seen.image.points
    light = np.abs((seen.image.normals * towards).sum(axis=1)) / np.linalg.norm(towards, axis=1)
    grey = 0.3 + 0.7 * light[:, None]
    palette: Callable[[int], tuple[float, ...]] = colormaps["tab10"]
    true = np.tile([0.35, 0.35, 0.35], (len(light), 1))
    true[seen.kinds == 1] = 0.9
    for number, body in enumerate(np.unique(seen.image.bodies[np.isin(seen.kinds, MOVABLE)])):
        true[(seen.image.bodies == body) & np.isin(seen.kinds, MOVABLE)] = palette(number % 10)[:3]
    shown = np.tile([0.35, 0.35, 0.35], (len(light), 1))
    shown[found.object] = 0.9
    for number, part in reversed(list(enumerate(found.parts))):
        shown[part.points] = (0.85, 0.1, 0.1) if number == 0 else palette(number % 10)[:3]
    figure = Figure(figsize=(12, 4.2))
    for axes, colours, name in zip(
        figure.subplots(1, 3), (np.ones((1, 3)), true, shown), (title, "true", "found, red: auto"), strict=True
    ):
        axes.imshow(image(colours * grey), interpolation="nearest")
        axes.set_title(name, fontsize=9)
        axes.axis("off")
    figure.tight_layout()
    figure.savefig(path, dpi=80)


if __name__ == "__main__":
    main("segmenting", SegmentingSettings, measure)
