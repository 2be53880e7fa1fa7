"""Depth images as scans: pixels become places, and whatever is no depth image is refused in one line."""

import struct
import zlib
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from adaafford.depth_images import Lens, parse_depth
from adaafford.histories import TriedOutcome, read_history
from adaafford.scans import read_scan
from adaafford.sessions import Session, SessionFiles
from cluster.cli.main import run as adaafford
from shared.errors import UsageError
from tests.support.small_policies import policy_of

LENS = Lens(intrinsics=(100.0, 100.0, 31.5, 23.5))


def chunk(kind: bytes, content: bytes) -> bytes:
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))


def png(depths: NDArray[np.uint16], filters: int | None = None, bits: int = 16) -> bytes:
    """A PNG whose lines have one filter, or each of the five in turn."""
    height, width = depths.shape
    values = depths.astype(">u2").view(np.uint8).reshape(height, 2 * width).astype(int)
    lines = []
    for row in range(height):
        kind = row % 5 if filters is None else filters
        left = np.concatenate([[0, 0], values[row, :-2]])
        above = values[row - 1] if row else np.zeros(2 * width, int)
        corner = np.concatenate([[0, 0], above[:-2]])
        guess = left + above - corner
        paeth = np.where(
            (abs(guess - left) <= abs(guess - above)) & (abs(guess - left) <= abs(guess - corner)),
            left,
            np.where(abs(guess - above) <= abs(guess - corner), above, corner),
        )
        told = (0 * left, left, above, (left + above) // 2, paeth)[kind]
        lines.append(bytes([kind]) + ((values[row] - told) % 256).astype(np.uint8).tobytes())
    header = struct.pack(">IIBBBBB", width, height, bits, 0, 0, 0, 0)
    packed = chunk(b"IDAT", zlib.compress(b"".join(lines)))
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + packed + chunk(b"IEND", b"")


def depths(seed: int = 1) -> NDArray[np.uint16]:
    made = np.random.default_rng(seed).integers(700, 900, (48, 64)).astype(np.uint16)
    made[:5] = 0
    return made


@pytest.mark.parametrize("filters", [None, 0, 1, 2, 3, 4])
def test_a_png_is_read_whatever_its_filters(filters: int | None) -> None:
    made = depths()
    scan = parse_depth(png(made, filters), Path("depth.png"), LENS, raw=False)
    assert scan.rows is not None and scan.missing == 5 * 64
    np.testing.assert_allclose(scan.points[:, 2], made.ravel()[scan.rows] / 1000)
    rows, columns = np.divmod(scan.rows, 64)
    np.testing.assert_allclose(scan.points[:, 0], (columns - 31.5) / 100 * scan.points[:, 2])
    np.testing.assert_allclose(scan.points[:, 1], (rows - 23.5) / 100 * scan.points[:, 2])


def test_arrays_in_metres_and_millimetres_say_the_same(tmp_path: Path) -> None:
    made = depths()
    metres = made / 1000
    metres[metres == 0] = np.nan
    whole = parse_depth(png(made), Path("depth.png"), LENS, raw=False).points
    np.save(tmp_path / "m.npy", metres)
    np.save(tmp_path / "mm.npy", made)
    np.savez(tmp_path / "m.npz", depth=metres, colour=np.zeros(3))
    for name in ("m.npy", "mm.npy", "m.npz"):
        scan = parse_depth((tmp_path / name).read_bytes(), tmp_path / name, LENS, raw=False)
        np.testing.assert_allclose(scan.points, whole, atol=1e-6)


def test_a_pose_moves_the_scan_and_its_camera() -> None:
    # A camera at (1, 0, 2) that looks along +x of the base: x right is -y, y down is -z, z forward is x.
    lens = Lens(intrinsics=LENS.intrinsics, pose=(1.0, 0.0, 2.0, -0.5, 0.5, -0.5, 0.5))
    own = parse_depth(png(depths()), Path("depth.png"), LENS, raw=False)
    moved = parse_depth(png(depths()), Path("depth.png"), lens, raw=False)
    x, y, z = own.points.T
    np.testing.assert_allclose(moved.points, np.stack([1 + z, -x, 2 - y], axis=1), atol=1e-9)
    assert moved.camera == (1.0, 0.0, 2.0)


@pytest.mark.parametrize(
    ("name", "data", "expected"),
    [
        ("d.png", b"", "is no PNG"),
        ("d.png", png(depths())[:-30], "cut off"),
        ("d.png", png(depths()).replace(b"IDAT", b"IDAX"), "damaged"),
        ("d.png", png(depths(), bits=8), "16 bits of grey"),
        ("d.npy", b"\x93NUMPY\x01\x00", "not readable as a depth image"),
        ("d.npz", b"PK\3\4", "not readable as a depth image"),
        ("d.ply", b"ply", "--intrinsics is for depth images"),
    ],
)
def test_what_is_no_depth_image_is_refused_in_one_line(name: str, data: bytes, expected: str) -> None:
    with pytest.raises(UsageError, match=expected) as refused:
        parse_depth(data, Path(name), LENS, raw=False)
    assert "\n" not in str(refused.value)


def test_absurd_sizes_cost_nothing() -> None:
    header = struct.pack(">IIBBBBB", 1 << 30, 1 << 30, 16, 0, 0, 0, 0)
    bomb = (
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(bytes(1000))) + chunk(b"IEND", b"")
    )
    with pytest.raises(UsageError, match="pixels; allowed"):
        parse_depth(bomb, Path("d.png"), LENS, raw=False)


@given(st.binary(max_size=200), st.integers(0, 3000))
def test_no_bytes_raise_anything_but_a_usage_error(noise: bytes, place: int) -> None:
    whole = png(depths())
    for suffix, data in ((".png", whole[:place] + noise + whole[place:]), (".npy", noise), (".npz", noise)):
        with suppress(UsageError):
            parse_depth(data, Path(f"d{suffix}"), LENS, raw=False)


def test_a_lens_is_checked() -> None:
    for wrong in ({"intrinsics": (0, 1, 1, 1)}, {"intrinsics": (1, 1, 1, 1e9)}):
        with pytest.raises(ValueError, match="needs fx"):
            Lens.model_validate(wrong)
    with pytest.raises(ValueError, match="quaternion"):
        Lens.model_validate({"intrinsics": (1, 1, 1, 1), "pose": (0, 0, 0, 0, 0, 0, 0)})


def test_a_session_keeps_the_lens(tmp_path: Path) -> None:
    for number in (1, 2):
        (tmp_path / f"depth-{number}.png").write_bytes(png(depths(number)))
    files = SessionFiles(tmp_path / "history.json", None)
    first = Session(policy_of(), files, points=128, lens=LENS).step(tmp_path / "depth-1.png")
    history = read_history(files.history)
    assert history.lens == LENS and history.frame.up == (0.0, -1.0, 0.0)
    assert 0.6 < first.point[2] < 1.0
    later = Session(policy_of(), files, points=128).step(tmp_path / "depth-2.png", TriedOutcome(motion=0.1), 1)
    assert later.tries == 1
    other = Lens(intrinsics=(90.0, 90.0, 31.5, 23.5))
    with pytest.raises(UsageError, match="begun with another camera"):
        Session(policy_of(), files, points=128, lens=other).step(tmp_path / "depth-2.png")


def test_the_command_asks_for_intrinsics(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    image = tmp_path / "depth.png"
    image.write_bytes(png(depths()))
    with pytest.raises(UsageError, match="--intrinsics FX FY CX CY"):
        read_scan(image)
    flags = ["--cloud", str(image), "--history", str(tmp_path / "h.json"), "--policy", "push-faucet"]
    assert adaafford(["adapt", *flags]) == 2
    assert adaafford(["adapt", *flags, "--pose", *"0000001"]) == 2
    assert adaafford(["adapt", *flags, "--intrinsics", *"0011"]) == 2
    said = capsys.readouterr().err.splitlines()
    assert len(said) == 3 and all("intrinsics" in line for line in said)
