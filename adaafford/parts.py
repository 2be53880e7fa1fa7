"""The movable part of a raw scan: found, chosen by confidence, by number or by a click, and followed from then on."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree

from adaafford.pretrained import PRETRAINED_FOLDER
from adaafford.scans import MAX_COORDINATE, Scan, ScanFrame, Vector
from shared.config import StrictModel
from shared.errors import UsageError
from shared.io.files import read_bounded
from shared.policies.policy import MAX_WEIGHTS_BYTES, WEIGHTS_FILE
from shared.segmentation.scenes import MOVABLE, Kind
from shared.segmentation.segmenter import (
    MAX_DOCUMENT_BYTES,
    SEGMENTATION_FILE,
    Evidence,
    Part,
    Segmentation,
    Segmenter,
)
from shared.tasks import Task
from shared.types import Float, Float32

SEGMENTATION = "segmentation"
"""Name of the bundled network."""
AUTO = "auto"
MAX_NUMBER = MAX_PARTS = 64
LEAST_CONFIDENCE = 0.1
"""That a part turns which rather slides; a task for turning parts considers it from here on."""
CLICK_M = 0.05
"""How far from a click a part may be."""
FOLLOW_M = 0.4
"""How far the middle of a part may move from one scan to the next."""
STILL_M, STILL_SHARE = 0.02, 0.8
"""A part did not move where this share of its points has a point of the next scan so near."""
WHOLE_STILL_SHARE = 0.97
"""The same of the object, since which nothing moved. Between scans of 30 real cabinets at rest at least 97.6% of the
points stayed, of the others a depth camera measures between surfaces; where a door turned by 0.05 rad at most 92.8%."""
STILL_POINTS = 5000
"""Of an object, about, that are looked for in the next scan."""
UNMOVED_M = 0.05
"""How far around a point that was gripped, and that did not move, nothing is marked."""
PICTURE_POINTS = 60_000
"""Of a raw scan, in the picture of its parts."""
PARTS_SUFFIX = "-parts"
"""Of the picture, beside the heatmap."""
FLOATING, NEIGHBOUR, MOST_FLOATING = 2.0, 3, 0.1
"""A point of the object floats where its third nearest neighbour is further than twice the median of these distances.
A depth camera measures a few such points between two surfaces; where they would be more than a tenth, the scan is
uneven instead, as one of several views is."""
_CHOSEN, _OTHER, _BODY, _BACKGROUND = 1.0, 0.75, 0.5, 0.0
"""Their values in the picture, which is coloured as a heatmap is."""


class PartError(UsageError):
    """No such part is found in a scan; another scan may show it."""


@dataclass(frozen=True, slots=True)
class PartChoice:
    """Which part is wanted: the most confident one unless a field says otherwise.

    Attributes:
        number: in order of confidence, from 1.
        point: on the part, in the frame of the scan.
    """

    number: int = 1
    point: Vector | None = None

    @classmethod
    def of(cls, told: str) -> "PartChoice":
        """The choice that "auto", "2" or "0.9,0.1,0.4" is.

        Raises:
            UsageError: it is none.
        """
        words = told.split(",")
        try:
            if told == AUTO:
                return cls()
            if len(words) == 1 and 1 <= int(told) <= MAX_NUMBER:
                return cls(int(told))
            x, y, z = (float(word) for word in words)
            if max(abs(x), abs(y), abs(z)) <= MAX_COORDINATE:
                return cls(point=(x, y, z))
        except ValueError:
            pass
        raise UsageError(
            f"--part {told[:60]}: give auto, a number from 1 to {MAX_NUMBER}, or a point on the part as X,Y,Z in "
            "metres, in the frame of the scan"
        )


def part_choice(told: str) -> str:
    """A choice as it is told, given back where it is one; raises as `PartChoice.of` does."""
    PartChoice.of(told)
    return told


class FoundPart(StrictModel):
    """A movable part that was found in a scan."""

    number: int = Field(ge=1)
    """In order of confidence, from 1; `--part` takes it."""
    kind: Literal["turning", "sliding"]
    confidence: float = Field(ge=0, le=1)
    """The network's mean probability over the part's points that they are of a part that moves as the task wants it,
    less for a part of few points."""
    centre: Vector
    """The median of the points that are seen of it, frame of the scan."""
    points: int
    """How many points of the scan are of it."""


class FollowedPart(StrictModel):
    """What a history keeps of the parts of a scan, to find the same part again in the next."""

    centre: Vector
    """The middle of the part."""
    others: Annotated[tuple[Vector, ...], Field(max_length=MAX_PARTS)] = ()
    """The middles of the other parts."""


class PartAnswer(StrictModel):
    """Which part a step is about."""

    chosen: FoundPart
    alternatives: tuple[FoundPart, ...]

    @property
    def followed(self) -> FollowedPart:
        """What a history keeps of it."""
        return FollowedPart(centre=self.chosen.centre, others=tuple(part.centre for part in self.alternatives))


@dataclass(frozen=True, slots=True)
class CutOut:
    """A raw scan with the object cut out and one part marked.

    Attributes:
        scan: of the object alone, without points that float between surfaces; `movable` marks the part.
        answer: which part that is, and what the others are.
        whole: the raw scan.
        shades: [M], of all points of the raw scan: 1 on the part, 0.75 on others, 0.5 on the body, 0 elsewhere.
        evidence: of this scan and of the scans before since which nothing moved.
    """

    scan: Scan
    answer: PartAnswer
    whole: Scan
    shades: Float32
    evidence: Evidence | None

    def picture(self) -> tuple[Float, Float32, NDArray[np.uint32]]:
        """Points of the raw scan, thinned, with their shades and their numbers, as heatmaps have them."""
        kept = np.linspace(0, len(self.shades) - 1, min(PICTURE_POINTS, len(self.shades))).astype(np.int64)
        rows = kept if self.whole.rows is None else self.whole.rows[kept]
        return self.whole.points[kept], self.shades[kept], rows.astype(np.uint32)


class PartFinder:
    """Finds the parts of raw scans that a task acts on.

    Args:
        task: for one that acts on turning parts alone, the confidence of a part is that it turns; None: not known.
        segmenter: the network; the bundled one unless given.
    """

    def __init__(self, task: Task | None, segmenter: Segmenter | None = None) -> None:
        self._segmenter = segmenter or bundled_segmenter()
        self._kinds = (Kind.TURNING,) if task is not None and task.revolute_only else MOVABLE
        self._last: tuple[Scan, Evidence | None, Segmentation, tuple[Part, ...]] | None = None

    def cut_out(
        self,
        scan: Scan,
        up: Vector,
        camera: Vector,
        choice: str,
        followed: FollowedPart | None,
        source: str,
        before: CutOut | None = None,
        unmoved: Sequence[Vector] = (),
    ) -> CutOut:
        """Cut the object out of a scan and mark one of its parts.

        Args:
            scan: a raw scan.
            up: against gravity, frame of the scan.
            camera: its position, frame of the scan.
            choice: which part is wanted (see `PartChoice.of`).
            followed: the parts of the scan before; the choice then counts no more.
            source: the scan's name in messages.
            before: an earlier scan. If nothing moved since, what the network says is averaged over it and this one. A
                part that it does not find again, and that did not move, is as there.
            unmoved: points that were pulled in vain, frame of the scan; around them the part is not marked, unless that
                is all of it.

        Raises:
            PartError: no such part is found.
            UsageError: the choice has no such number or point, or the points are marked already.
        """
        if scan.movable is not None:
            raise UsageError(f"{source}: says itself which points are movable; leave out --part, or 'movable'")
        earlier = before.evidence if before is not None and _nothing_moved(scan, before) else None
        found, parts = self._parts(scan, up, camera, source, earlier)
        numbered = [_shown_part(scan, part, number) for number, part in enumerate(parts, start=1)]
        chosen = None if followed is None else _again(numbered, followed)
        if chosen is None and before is not None and (still := _still(scan, before)) is not None:
            chosen, parts = len(parts), (*parts, still)
            numbered.append(_shown_part(scan, still, len(parts)))
        if not parts:
            kinds = " or ".join(kind.name.lower() for kind in self._kinds)
            raise PartError(
                f"{source}: no {kinds} part is found on the object; look from another side, or mark the points to act "
                "on as 'movable' and leave out --part"
            )
        if followed is None:
            chosen = _chosen(scan, parts, numbered, PartChoice.of(choice), source)
        elif chosen is None:
            raise PartError(
                f"{source}: the part that was at {_shown(followed.centre)} in the scan before is not found again; scan "
                f"the object anew under another name, or begin another history. {_listed(numbered)}"
            )
        shades = np.full(len(scan.points), _BACKGROUND, dtype=np.float32)
        shades[found.object] = _BODY
        for part in parts:
            shades[part.points] = _OTHER
        shades[parts[chosen].points] = _CHOSEN
        of_object = np.flatnonzero(shades)
        rows = of_object[_on_surfaces(scan.points[of_object])]
        if not (shades[rows] == _CHOSEN).any():
            rows = of_object
        movable = shades[rows] == _CHOSEN
        if unmoved:
            free = cKDTree(np.array(unmoved)).query(scan.points[rows])[0] > UNMOVED_M
            movable = movable & free if (movable & free).any() else movable
        cut = replace(
            scan,
            points=scan.points[rows],
            normals=None if scan.normals is None else scan.normals[rows],
            movable=movable,
            rows=rows if scan.rows is None else scan.rows[rows],
        )
        others = tuple(part for number, part in enumerate(numbered) if number != chosen)
        return CutOut(cut, PartAnswer(chosen=numbered[chosen], alternatives=others), scan, shades, found.evidence)

    def _parts(
        self, scan: Scan, up: Vector, camera: Vector, source: str, earlier: Evidence | None
    ) -> tuple[Segmentation, tuple[Part, ...]]:
        """What is in a scan; it is remembered until another scan comes."""
        if self._last is None or self._last[0] is not scan or self._last[1] is not earlier:
            frame = ScanFrame(up=up, camera=camera, origin=(0.0, 0.0, 0.0))
            try:
                points, place = frame.to_world(scan.points), frame.to_world([camera])[0]
                found = self._segmenter.segment(points, place, earlier=earlier)
            except UsageError as error:
                raise PartError(f"{source}: {error}") from None
            self._last = scan, earlier, found, self._suitable(found.parts)[:MAX_PARTS]
        _, _, found, parts = self._last
        return found, parts

    def _suitable(self, parts: tuple[Part, ...]) -> tuple[Part, ...]:
        """The parts that may move as the task wants it, in the order of the confidence that they do."""
        suitable = []
        for part in parts:
            wanted = replace(part, confidences={k: c for k, c in part.confidences.items() if k in self._kinds})
            if part.kind in self._kinds or wanted.confidence >= LEAST_CONFIDENCE:
                suitable.append(wanted)
        return tuple(sorted(suitable, key=lambda part: -part.confidence))


def _on_surfaces(points: Float) -> NDArray[np.bool_]:
    """Which points, [N, 3], lie among others as those of a surface do; where they float, a hand would close on air."""
    if len(points) <= NEIGHBOUR:
        return np.ones(len(points), dtype=bool)
    away = np.asarray(cKDTree(points).query(points, k=[NEIGHBOUR + 1], workers=-1)[0])[:, 0]
    floating = away > FLOATING * np.median(away)
    lies: NDArray[np.bool_] = ~floating if floating.mean() <= MOST_FLOATING else np.ones(len(points), dtype=bool)
    return lies


@cache
def bundled_segmenter() -> Segmenter:
    """The bundled network."""
    return read_segmenter(PRETRAINED_FOLDER / SEGMENTATION)


def read_segmenter(folder: Path) -> Segmenter:
    """A network from the folder that its training left; raises StoreError where a file is missing or damaged."""
    limits = {WEIGHTS_FILE: MAX_WEIGHTS_BYTES, SEGMENTATION_FILE: MAX_DOCUMENT_BYTES}
    return Segmenter.from_files({name: read_bounded(folder / name, limit) for name, limit in limits.items()})


def _shown_part(scan: Scan, part: Part, number: int) -> FoundPart:
    return FoundPart(
        number=number,
        kind="turning" if part.kind is Kind.TURNING else "sliding",
        confidence=round(part.confidence, 4),
        centre=_vector(np.median(scan.points[part.points], axis=0)),
        points=len(part.points),
    )


def _chosen(scan: Scan, parts: tuple[Part, ...], numbered: list[FoundPart], choice: PartChoice, source: str) -> int:
    if choice.number > len(parts):
        raise UsageError(f"{source}: --part {choice.number}: {_listed(numbered)}; give one of these numbers, or auto")
    if choice.point is None:
        return choice.number - 1
    click = np.array(choice.point)
    away = [float(np.linalg.norm(scan.points[part.points] - click, axis=1).min()) for part in parts]
    nearest = int(np.argmin(away))
    if not away[nearest] <= CLICK_M:
        raise UsageError(
            f"{source}: the point {_shown(choice.point)} is {away[nearest]:.2f} m from the nearest part that was "
            f"found, and {CLICK_M:g} m is allowed; {_listed(numbered)}"
        )
    return nearest


def _again(numbered: list[FoundPart], followed: FollowedPart) -> int | None:
    """The part that was followed, where all parts together moved the least; None where it is not found."""
    if not numbered:
        return None
    before = np.array([followed.centre, *followed.others])
    away = np.linalg.norm(before[:, None] - np.array([part.centre for part in numbered]), axis=2)
    rows, columns = linear_sum_assignment(np.minimum(away, FOLLOW_M))
    again = {int(row): int(column) for row, column in zip(rows, columns, strict=True)}
    return again[0] if 0 in again and away[0, again[0]] < FOLLOW_M else None


def _nothing_moved(scan: Scan, before: CutOut) -> bool:
    """Whether the object of an earlier scan is where it was."""
    was = before.whole.points[before.shades != _BACKGROUND]
    was = was[:: 1 + len(was) // STILL_POINTS]
    around = (scan.points >= was.min(axis=0) - STILL_M) & (scan.points <= was.max(axis=0) + STILL_M)
    places = scan.points[around.all(axis=1)]
    if len(places) == 0:
        return False
    tree = cKDTree(places, balanced_tree=False, compact_nodes=False)
    away = np.asarray(tree.query(was, distance_upper_bound=STILL_M, workers=-1)[0])
    return bool(np.isfinite(away).mean() >= WHOLE_STILL_SHARE)


def _still(scan: Scan, before: CutOut) -> Part | None:
    """The part of an earlier scan where it did not move; None where it did."""
    known = np.flatnonzero(before.shades)
    tree = cKDTree(before.whole.points[known])
    away, nearest = map(np.asarray, tree.query(scan.points, distance_upper_bound=STILL_M, workers=-1))
    near = np.flatnonzero(np.isfinite(away))
    points = near[before.shades[known[nearest[near]]] == _CHOSEN]
    if len(points) == 0:
        return None
    was = before.whole.points[before.shades == _CHOSEN]
    if np.mean(cKDTree(scan.points[points]).query(was, workers=-1)[0] < STILL_M) < STILL_SHARE:
        return None
    chosen = before.answer.chosen
    return Part(points, {Kind[chosen.kind.upper()]: chosen.confidence})


def _listed(numbered: list[FoundPart]) -> str:
    shown = [f"{part.number} at {_shown(part.centre)} ({part.confidence:.2f})" for part in numbered[:8]]
    return f"parts found, with confidence: {'; '.join(shown)}{'; ...' if len(numbered) > 8 else ''}"


def _shown(point: Vector) -> str:
    return ",".join(f"{value:.2f}" for value in point)


def _vector(point: Float) -> Vector:
    x, y, z = (round(float(value), 4) for value in point)
    return x, y, z
