"""Furthest-point sampling: each sample is the furthest there is, and ties go as they always went."""

import hashlib
import os
import shutil
import signal
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numba.core.dispatcher import Dispatcher
from numpy.typing import NDArray

from shared import compilation
from shared.compilation import compiled
from shared.io import private
from shared.policies import furthest_points as module
from shared.policies.furthest_points import furthest_points


def assert_furthest(points: NDArray[np.float32], chosen: NDArray[np.int64]) -> None:
    """Every sample after the first is, in single precision, as far from those before as any point is."""
    squared = np.full(len(points), np.inf, dtype=np.float32)
    for number, sample in enumerate(chosen):
        assert number == 0 or squared[sample] == squared.max()
        x, y, z = (points - points[sample]).T
        squared = np.minimum(squared, x * x + y * y + z * z)


@settings(max_examples=60)
@given(st.integers(1, 400), st.floats(0.0, 1.0), st.booleans(), st.integers(0, 2**32 - 1))
def test_furthest_points_of_any_cloud_are_each_the_furthest(size: int, share: float, grid: bool, seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = (rng.integers(0, 3, (size, 3)) if grid else rng.normal(size=(size, 3))).astype(np.float32)
    count = max(1, round(share * size))
    chosen = furthest_points(points, count)
    assert chosen.shape == (count,)
    assert chosen.min() >= 0 and chosen.max() < size
    assert_furthest(points, chosen)


def test_furthest_points_of_a_cloud_are_all_of_it_once() -> None:
    points = np.random.default_rng(1).normal(size=(257, 3)).astype(np.float32)
    assert sorted(furthest_points(points, 257)) == list(range(257))


# Digests of what fpsample 1.0.2 and 0.3.3 (`bucket_fps_kdline_sampling`, h=5) gave: stores were made with it.
@pytest.mark.parametrize(
    ("size", "count", "steps", "digest"),
    [
        (20_000, 2048, 0, "4b50daa42dfa3fdd"),
        (20_000, 2048, 24, "bb88925ce819a05f"),
        (64, 64, 3, "1a2423328eb3d1f9"),
    ],
)
def test_furthest_points_that_are_equally_far_come_in_the_order_of_stored_data(
    size: int, count: int, steps: int, digest: str
) -> None:
    points = np.random.default_rng(7).uniform(-1, 1, (size, 3))
    if steps:  # Few places, so that many points are equally far.
        points = np.round(points * steps) / steps
    chosen = furthest_points(points.astype(np.float32), count)
    assert hashlib.sha256(chosen.astype("<i8").tobytes()).hexdigest()[:16] == digest


@pytest.mark.slow
def test_compiled_code_is_kept_in_the_cache_of_the_user_and_nowhere_without_a_home(tmp_path: Path) -> None:
    """Of a small function, since ours take seconds to compile."""
    here, cache, temporary = tmp_path / "here", tmp_path / "cache", Path(tempfile.mkdtemp(prefix="t", dir="/tmp"))
    here.mkdir()
    script = tmp_path / "small.py"
    script.write_text("from shared.compilation import compiled\n@compiled()\ndef f(x):\n    return x + 1\nf(1)\n")
    base = {name: value for name, value in os.environ.items() if name not in ("HOME", "XDG_CACHE_HOME")}
    base |= {"PYTHONPATH": str(Path(__file__).parents[2]), "TMPDIR": str(temporary)}
    for more in ({"XDG_CACHE_HOME": str(cache)}, {"HOME": "~"}):
        done = subprocess.run(
            [sys.executable, str(script)], env=base | more, cwd=here, capture_output=True, text=True, check=False
        )
        assert (done.returncode, done.stderr) == (0, "")
    assert list(cache.rglob("*.nbi"))
    assert list(temporary.rglob("*.nbi"))
    assert list(here.iterdir()) == []
    shutil.rmtree(temporary)


def test_an_interrupt_during_a_compilation_waits_for_its_end(monkeypatch: pytest.MonkeyPatch) -> None:
    done: list[str] = []

    class Interrupted:
        def compile(self, signature: str) -> None:
            signal.raise_signal(signal.SIGINT)
            done.append(signature)

    monkeypatch.setattr(compilation, "njit", lambda function, **_: Interrupted())
    kept: Any = compiled()(abs)
    # A shell lets what it starts in the background ignore the signal.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt):
            kept.compile("int64(int64)")
    finally:
        signal.signal(signal.SIGINT, before)
    assert done == ["int64(int64)"]


def test_all_that_is_compiled_is_kept_there() -> None:
    compiled = [each for each in vars(module).values() if isinstance(each, Dispatcher)]
    assert len(compiled) > 2
    furthest_points(np.eye(3, dtype=np.float32), 2)
    for each in compiled:
        assert Path(each.stats.cache_path).is_relative_to(private.cache_folder("numba")), each
