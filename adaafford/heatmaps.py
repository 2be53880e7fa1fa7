"""Heatmaps: a cloud with the affordance of each point, as PLY for viewers, NPZ for programs, HTML for people."""

import io
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from shared.errors import UsageError
from shared.io.files import write_atomically, writing
from shared.types import Float, Float32

Writer = Callable[[Float, Float32, NDArray[np.uint32], NDArray[np.bool_] | None], bytes]
_OUT_OF_REACH = (120, 120, 120)
_HEAT = ((30, 60, 140), (245, 245, 245), (200, 20, 30))


def write_heatmap(
    path: Path,
    points: Float,
    affordance: Float32,
    indices: NDArray[np.uint32],
    reachable: NDArray[np.bool_] | None = None,
) -> None:
    """Write a heatmap in the format given by the suffix of the file.

    Args:
        path: .ply (coloured, with a property `affordance`), .npz (`points`, `affordance`, `indices`) or .html.
        points: [N, 3], in the scan's frame.
        affordance: [N], in [0, 1].
        indices: [N], which points of the scan these are.
        reachable: [N], whether an arm reaches the point; grey where it does not, and a property or array `reachable`.
            None: there is no arm.

    Raises:
        UsageError: the suffix is not allowed, or the folder cannot be written to.
    """
    writer = heatmap_writer(path)
    with writing(path):
        write_atomically(path, writer(points, affordance, indices, reachable))


def heatmap_writer(path: Path) -> Writer:
    """What makes the bytes of a heatmap of this name.

    Raises:
        UsageError: the name ends otherwise.
    """
    if path.suffix.lower() not in _WRITERS:
        raise UsageError(f"{path}: not a kind of heatmap that is written; allowed: {', '.join(_WRITERS)}")
    return _WRITERS[path.suffix.lower()]


def colours(affordance: Float32, reachable: NDArray[np.bool_] | None = None) -> NDArray[np.uint8]:
    """From dark blue (0) over white (0.5) to red (1), [N, 3]; grey where an arm does not reach."""
    found = blended(_HEAT, affordance)
    if reachable is not None:
        found[~reachable] = _OUT_OF_REACH
    return found


def blended(stops: Sequence[Sequence[int]], shares: Float | Float32) -> NDArray[np.uint8]:
    """Colours on a scale, [N, 3].

    Args:
        stops: colours at equal distances, from share 0 to share 1.
        shares: [N]; beyond the scale, its ends count.
    """
    scale = np.array(stops, dtype=np.float64)
    places = np.clip(shares, 0.0, 1.0).astype(np.float64) * (len(scale) - 1)
    mixed = np.stack([np.interp(places, np.arange(len(scale)), channel) for channel in scale.T], axis=1)
    rounded: NDArray[np.uint8] = np.rint(mixed).astype(np.uint8)
    return rounded


def _ply(points: Float, affordance: Float32, indices: NDArray[np.uint32], reachable: NDArray[np.bool_] | None) -> bytes:
    fields = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1")]
    fields += [("affordance", "<f4")] + ([] if reachable is None else [("reachable", "u1")])
    rows = np.zeros(len(points), dtype=fields)
    for axis, name in enumerate("xyz"):
        rows[name] = points[:, axis]
    for name, shown in zip(("red", "green", "blue"), colours(affordance, reachable).T, strict=True):
        rows[name] = shown
    rows["affordance"] = affordance
    if reachable is not None:
        rows["reachable"] = reachable
    names = {"<f4": "float", "u1": "uchar"}
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}"]
    header += [f"property {names[kind]} {name}" for name, kind in fields]
    return "\n".join([*header, "end_header\n"]).encode() + rows.tobytes()


def _npz(points: Float, affordance: Float32, indices: NDArray[np.uint32], reachable: NDArray[np.bool_] | None) -> bytes:
    held = io.BytesIO()
    arm = {} if reachable is None else {"reachable": reachable}
    np.savez_compressed(held, allow_pickle=False, points=points, affordance=affordance, indices=indices, **arm)
    return held.getvalue()


def _html(
    points: Float, affordance: Float32, indices: NDArray[np.uint32], reachable: NDArray[np.bool_] | None
) -> bytes:
    # Plotly takes a second to import and its page is some megabytes, so only where it is asked for.
    import plotly.graph_objects as go

    x, y, z = points.T
    shown = [f"rgb({r},{g},{b})" for r, g, b in colours(affordance, reachable)]
    marker = {"size": 3, "color": shown}
    texts = [f"{value:.2f}" for value in affordance]
    cloud = go.Scatter3d(x=x, y=y, z=z, mode="markers", marker=marker, text=texts, hoverinfo="text")
    title = "affordance: blue 0, white 0.5, red 1" + ("" if reachable is None else "; grey: out of reach")
    figure = go.Figure(
        cloud,
        {"scene": {"aspectmode": "data"}, "title": title},
    )
    page: str = figure.to_html(include_plotlyjs=True, full_html=True)
    return page.encode()


_WRITERS = {".ply": _ply, ".npz": _npz, ".html": _html}
