"""Scans out of recordings of ROS 2: storages, layouts of messages, topics, frames, and whatever is no recording."""

import json
import sqlite3
import struct
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.typesys import Stores

import shared.extras as extras_module
from adaafford.depth_images import Lens, parse_depth, read_rvl
from adaafford.histories import TriedOutcome, read_history
from adaafford.recording_process import scan_of
from adaafford.recordings import Selection, is_recording
from adaafford.ros_messages import cloud_scan, unpacked_depth
from adaafford.scans import Scan, parse_scan, read_scan
from adaafford.sessions import Session, SessionFiles
from cluster.cli.main import run as adaafford
from shared.errors import UsageError
from shared.types import Float
from tests.support.ros_recordings import OPTICAL, Messages, png, rvl
from tests.support.small_policies import policy_of

ROS = Messages()
LENS = (100.0, 110.0, 31.5, 23.5)


def points(seed: int = 0, count: int = 240) -> Float:
    rng = np.random.default_rng(seed)
    made: Float = rng.uniform([-0.3, -0.3, 0.9], [0.3, 0.3, 1.0], (count, 3)).astype(np.float32).astype(np.float64)
    return made


def depths(seed: int = 0) -> Any:
    made = np.random.default_rng(seed).integers(700, 900, (48, 64)).astype("<u2")
    made[:5] = 0
    return made


def taken(path: Path, **selection: Any) -> Scan:
    """The scan of a recording, read in this process."""
    return parse_scan(scan_of(path, Selection(**selection))[0], path, kind=".npz")


@pytest.mark.parametrize("store", [Stores.ROS2_HUMBLE, Stores.ROS2_JAZZY])
@pytest.mark.parametrize(
    ("storage", "packing"), [("mcap", ""), ("mcap", "zstd"), ("mcap", "lz4"), ("sqlite3", ""), ("sqlite3", "message")]
)
def test_the_last_cloud_is_taken_or_the_last_until_a_time(
    storage: str, packing: str, store: Stores, tmp_path: Path
) -> None:
    ros = Messages(store)
    said = [("/points", 30.0 * k, ros.cloud(points(k), stamp=30.0 * k)) for k in range(3)]
    folder = ros.write(tmp_path / "drive", said, storage, packing)
    (file,) = [*folder.glob("*.mcap"), *folder.glob("*.db3")]
    for path in (folder, file):
        np.testing.assert_array_equal(taken(path).points, points(2))
        np.testing.assert_array_equal(taken(path, at=59.9).points, points(1))
        np.testing.assert_array_equal(taken(path, at=0).points, points(0))
    assert taken(folder).up == (0, -1, 0) and taken(folder).camera is None
    line = scan_of(folder, Selection())[1]
    assert "/points 60.000 s after the beginning, in the frame camera_depth_optical_frame" in line
    later = ros.write(tmp_path / "later", [("/other", 0, ros.transforms()), ("/points", 9, said[0][2])], storage)
    with pytest.raises(UsageError, match="no message of /points until then"):
        taken(later, at=5)


LAYOUTS = {
    "padded": {"dtype": [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("_", "<f4")], "rows": 12, "gap": 20},
    "big endian": {"dtype": [("x", ">f4"), ("y", ">f4"), ("z", ">f4")], "rows": 4, "gap": 3},
    "doubles": {"dtype": [("x", "<f8"), ("y", "<f8"), ("z", "<f8")]},
    "other fields": {
        "dtype": [("rgb", "<f4"), ("z", "<f4"), ("ring", "<u2"), ("x", "<f4"), ("t", "<f8"), ("y", "<f4")]
    },
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_cloud_is_read_whatever_its_layout(layout: str) -> None:
    found = cloud_scan(ROS.cloud(points(), **LAYOUTS[layout]))
    np.testing.assert_array_equal(found["points"], points())
    assert found.keys() == {"points", "up"}


def test_normals_and_marks_are_taken_and_unmeasured_points_left_out(tmp_path: Path) -> None:
    records = np.zeros(
        (1, 200), [(name, "<f4") for name in ("x", "y", "z", "normal_x", "normal_y", "normal_z", "movable")]
    )
    for name, values in zip("xyz", points(count=200).T, strict=True):
        records[name] = values
    records["normal_z"], records["movable"][0, :50], records["x"][0, 3], records["z"][0, 7] = -1, 1, np.nan, np.inf
    for name in "xyz":
        records[name][0, 9] = 0
    base = ROS.transform("base", OPTICAL, (1, 2, 3), LOOKS_ALONG_X)
    said = [("/tf_static", 0, ROS.transforms(base)), ("/points", 0, ROS.cloud_of(records))]
    folder = ROS.write(tmp_path / "drive", said)
    for selection in ({}, {"frame": "base"}):
        scan = taken(folder, **selection)
        assert scan.missing == 3 and scan.rows is not None and not {3, 7, 9} & set(scan.rows)
        assert scan.movable is not None and scan.normals is not None and scan.movable.sum() == 47
    np.testing.assert_allclose(scan.normals[:, 0], -1, atol=1e-6, err_msg="z forward is x of the base")


@pytest.mark.parametrize(
    ("wrong", "expected"),
    [
        ({"row_step": 10}, "announces"),
        ({"width": 1 << 31, "height": 1 << 31}, "points; allowed"),
        ({"width": 0}, "points; allowed"),
        ({"point_step": 0}, "announces"),
        ({"data": np.zeros(100, np.uint8)}, "holds 100 bytes"),
        ({"fields": []}, "no x y z"),
        ({"fields": [ROS.make("sensor_msgs/msg/PointField", "x", 0, 7, 1)] * 2}, "no x y z"),
        ({"fields": [ROS.make("sensor_msgs/msg/PointField", name, 10, 7, 1) for name in "xyz"]}, "outside of a point"),
        ({"fields": [ROS.make("sensor_msgs/msg/PointField", name, 0, 99, 1) for name in "xyz"]}, "datatype 99"),
        ({"fields": [ROS.make("sensor_msgs/msg/PointField", name, 0, 7, 3) for name in "xyz"]}, "count 3"),
    ],
)
def test_a_cloud_that_contradicts_itself_is_refused(wrong: dict[str, Any], expected: str) -> None:
    message = ROS.cloud(points(), rows=4)
    for name, value in wrong.items():
        setattr(message, name, value)
    with pytest.raises(ValueError, match=expected):
        cloud_scan(message)


NUMBER = st.sampled_from([0, 1, 2, 12, 48, 240, 2880, (1 << 31) - 1, (1 << 32) - 1])


@given(NUMBER, NUMBER, NUMBER, NUMBER, NUMBER, st.integers(0, 9))
def test_no_numbers_of_a_cloud_raise_anything_but_a_value_error(
    height: int, width: int, step: int, row: int, offset: int, kind: int
) -> None:
    message = ROS.cloud(points())
    message.height, message.width, message.point_step, message.row_step = height, width, step, row
    message.fields[0].offset, message.fields[1].datatype = offset, kind
    try:
        assert cloud_scan(message)["points"].shape == (height * width, 3)
    except ValueError as error:
        assert "\n" not in str(error)


@pytest.mark.parametrize(
    ("pixels", "encoding", "gap"),
    [
        (depths(), "16UC1", 0),
        (depths().astype(">u2"), "16UC1", 6),
        (np.where(depths() == 0, np.nan, depths() / 1000).astype("<f4"), "32FC1", 12),
    ],
)
def test_a_depth_image_says_the_same_as_its_file_with_intrinsics(
    pixels: Any, encoding: str, gap: int, tmp_path: Path
) -> None:
    said = [
        ("/camera/color/image_raw", 0, ROS.image(np.zeros((4, 4), np.uint8), "mono8")),
        ("/camera/depth/image_rect_raw", 0, ROS.image(pixels, encoding, gap=gap)),
        ("/camera/depth/camera_info", 0, ROS.camera_info(pixels.shape, LENS)),
        ("/camera/color/camera_info", 0, ROS.camera_info((4, 4), (1, 1, 1, 1))),
    ]
    np.save(tmp_path / "depth.npy", pixels)
    file = parse_depth((tmp_path / "depth.npy").read_bytes(), Path("depth.npy"), Lens(intrinsics=LENS), raw=False)
    scan = taken(ROS.write(tmp_path / "drive", said))
    np.testing.assert_allclose(scan.points, file.points, atol=1e-6)
    assert scan.missing == file.missing == 5 * 64 and scan.up == file.up


HEADER = struct.Struct("<iff")
INVERSE = (31.25, -3.0)
"""How the transport `compressedDepth` sends metres: a / depth + b."""


def inverse_depths() -> Any:
    """Depths as they are sent, and in metres as they are meant."""
    sent = np.where(depths() == 0, 0, np.rint(INVERSE[0] / (np.maximum(depths(), 1) / 1000) + INVERSE[1])).astype("<u2")
    with np.errstate(divide="ignore"):
        return sent, np.where(sent == 0, 0.0, INVERSE[0] / (sent - INVERSE[1]))


@pytest.mark.parametrize("transport", ["compressedDepth png", "compressedDepth", "compressedDepth rvl", "png", "bare"])
@pytest.mark.parametrize("metres", [False, True])
def test_a_compressed_depth_image_says_the_same_as_the_image(transport: str, metres: bool, tmp_path: Path) -> None:
    sent, meant = inverse_depths() if metres else (depths(), depths() / 1000)
    inverse = "compressedDepth" in transport
    data = rvl(sent) if "rvl" in transport else png(sent)
    encoding = "32FC1" if metres else "16UC1"
    form = "png" if transport == "bare" else f"{encoding}; {'png compressed ' if transport == 'png' else transport}"
    image = ROS.compressed(form, HEADER.pack(0, *INVERSE) * inverse + data)
    said = [
        ("/camera/color/image_raw/compressed", 0, ROS.compressed("rgb8; jpeg compressed bgr8", b"\xff\xd8")),
        ("/camera/depth/image_rect_raw/compressedDepth", 0, image),
        ("/camera/depth/camera_info", 0, ROS.camera_info(sent.shape, LENS, (0.1, 0, 0, 0, 0))),
        ("/camera/color/camera_info", 0, ROS.camera_info((4, 4), (1, 1, 1, 1))),
    ]
    folder = ROS.write(tmp_path / "drive", said)
    if transport == "png" and metres:
        with pytest.raises(ValueError, match="rounds them; record compressedDepth"):
            taken(folder)
        return
    # A bare PNG says nothing of metres, so its numbers are millimetres.
    meant = sent / 1000 if transport == "bare" else meant
    whole = Lens(intrinsics=(LENS[0] / 2, LENS[1] / 2, *LENS[2:])).points(meant)
    np.testing.assert_allclose(taken(folder).points, whole[whole.any(axis=1)], rtol=1e-6)


@pytest.mark.parametrize(
    ("form", "data", "expected"),
    [
        ("16UC1; compressedDepth png", b"short", "fewer than its header"),
        ("16UC1; compressedDepth png", bytes(50), "is no PNG"),
        ("16UC1; compressedDepth rvl", bytes(12) + rvl(depths())[:-400], "cut off"),
        ("16UC1; compressedDepth rvl", bytes(12) + struct.pack("<iiI", 64, 48, 0xFFFFFFFF), "damaged"),
        ("16UC1; compressedDepth rvl", bytes(12) + struct.pack("<iiI", 64, 48, 0), "damaged"),
        ("16UC1; compressedDepth rvl", bytes(12) + struct.pack("<iiI", 1 << 20, 1 << 20, 0), "pixels; allowed"),
        ("16UC1; png compressed ", png(depths(), colour=2), "16 bits of grey"),
        ("rgb8; jpeg compressed bgr8", b"\xff\xd8", "its format is 'rgb8; jpeg"),
    ],
)
def test_a_compressed_image_that_is_no_depth_image_is_refused(form: str, data: bytes, expected: str) -> None:
    with pytest.raises(ValueError, match=expected):
        unpacked_depth(ROS.compressed(form, data))


@given(st.binary(max_size=200))
def test_no_bytes_of_rvl_raise_anything_but_a_value_error(data: bytes) -> None:
    with suppress(ValueError):
        assert read_rvl(struct.pack("<ii", 8, 8) + data).shape == (8, 8)


def test_a_distorted_image_is_refused_and_a_rectified_one_has_the_projection(tmp_path: Path) -> None:
    info = ROS.camera_info((48, 64), LENS, (0.1, 0, 0, 0, 0))
    raw = ROS.write(tmp_path / "raw", [("/d/image_raw", 0, ROS.image(depths())), ("/d/camera_info", 0, info)])
    with pytest.raises(ValueError, match="distortion; record the rectified"):
        taken(raw)
    rect = ROS.write(tmp_path / "rect", [("/d/image_rect", 0, ROS.image(depths())), ("/d/camera_info", 0, info)])
    lens = Lens(intrinsics=(LENS[0] / 2, LENS[1] / 2, *LENS[2:]))
    whole = lens.points(depths())
    np.testing.assert_allclose(taken(rect).points, whole[whole.any(axis=1)], atol=1e-6)


def test_an_image_needs_the_camera_info_of_its_camera(tmp_path: Path) -> None:
    image = ("/d/image", 0, ROS.image(depths()))
    with pytest.raises(UsageError, match="needs the topic /d/camera_info"):
        taken(ROS.write(tmp_path / "none", [image]))
    only = ROS.write(tmp_path / "only", [image, ("/info", 3, ROS.camera_info((48, 64), LENS))])
    assert len(taken(only).points) == 43 * 64
    other = ROS.write(tmp_path / "other", [image, ("/info", 0, ROS.camera_info((480, 640), LENS))])
    with pytest.raises(ValueError, match="640 x 480 pixels, the image of 64 x 48"):
        taken(other)


def test_a_topic_is_named_where_there_are_several(tmp_path: Path) -> None:
    said = [("/left", 0, ROS.cloud(points(1))), ("/right", 0, ROS.cloud(points(2))), ("/tf", 0, ROS.transforms())]
    several = ROS.write(tmp_path / "several", said)
    with pytest.raises(
        UsageError, match="scans of 2 topics; clouds: /left /right; images: nothing; name one by --topic"
    ):
        taken(several)
    np.testing.assert_array_equal(taken(several, topic="/right").points, points(2))
    for topic in ("/tf", "/nothing"):
        with pytest.raises(UsageError, match=f"no cloud or image of the topic {topic}; clouds: /left /right"):
            taken(several, topic=topic)
    with pytest.raises(UsageError, match="scans of 0 topics"):
        taken(ROS.write(tmp_path / "none", said[2:]))
    # A cloud is preferred to the depth image that it was made of.
    both = [said[0], ("/d/image", 0, ROS.image(depths()))]
    np.testing.assert_array_equal(taken(ROS.write(tmp_path / "both", both)).points, points(1))


LOOKS_ALONG_X = (-0.5, 0.5, -0.5, 0.5)
"""Of an optical frame: x right is -y, y down is -z, z forward is x."""


def test_a_scan_is_moved_to_a_frame_by_the_nearest_transformations(tmp_path: Path) -> None:
    static = ROS.transforms(
        ROS.transform("/head", OPTICAL, (0.1, 0, 0), LOOKS_ALONG_X), ROS.transform("torso", "base", (0, 0, -0.5))
    )
    moving = [ROS.transforms(ROS.transform("torso", "head", (k, 0, 0.5), stamp=100 + 0.4 * k)) for k in range(5)]
    said = [
        ("/tf_static", 0, static),
        ("/points", 0.85, ROS.cloud(points(), stamp=100.85)),
        *(("/tf", 0.4 * k, each) for k, each in enumerate(moving)),
    ]
    folder = ROS.write(tmp_path / "drive", said)
    scan, (x, y, z) = taken(folder, frame="base"), points().T
    # The nearest is that of 100.8 s, where the head is at 2 0 0.5 of the torso, and the torso 0.5 above the base.
    np.testing.assert_allclose(scan.points, np.stack([2.1 + z, -x, 1.0 - y], axis=1), atol=1e-5)
    np.testing.assert_allclose(scan.camera or (), (2.1, 0, 1), atol=1e-5)
    assert scan.up is None, "which is 0 0 1 by default"
    np.testing.assert_allclose(taken(folder, frame=OPTICAL).points, points(), atol=1e-6)
    assert taken(folder, frame=OPTICAL).up == (0, -1, 0)
    with pytest.raises(ValueError, match="do not connect 'camera_depth_optical_frame' with 'world'; frames: base"):
        taken(folder, frame="world")
    late = ROS.write(tmp_path / "late", [*said[:1], ("/points", 0, ROS.cloud(points(), stamp=90.0)), *said[2:]])
    with pytest.raises(ValueError, match=r"'head' nearest to the scan is 10\.00 s away"):
        taken(late, frame="base")
    circle = ROS.transforms(ROS.transform("a", OPTICAL, (0, 0, 0)), ROS.transform(OPTICAL, "a", (0, 0, 0)))
    with pytest.raises(ValueError, match="in a circle"):
        taken(ROS.write(tmp_path / "circle", [("/tf_static", 0, circle), said[1]]), frame="a")


def test_a_session_keeps_the_scan_of_a_recording_as_a_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("adaafford.sessions.take_scan", scan_of)
    said = [("/points", 10.0 * k, ROS.cloud(points(k))) for k in range(2)]
    recording = ROS.write(tmp_path / "drive", said) / "drive.mcap"
    (tmp_path / "session").mkdir()
    files, told = SessionFiles(tmp_path / "session" / "history.json", None), list[str]()
    session = Session(policy_of(), files, points=128, tell=told.append)
    first = session.step(recording, at=0)
    assert len(told) == 1 and "/points 0.000 s after the beginning" in told[0]
    assert session.step(recording, at=0).point == first.point and len(told) == 1
    second = session.step(recording, TriedOutcome(motion=0.1), 1, at=12)
    assert second.tries == 1 and len(told) == 2
    history = read_history(files.history)
    assert history.frame.up == (0, -1, 0)
    kept = [files.history.parent / each.cloud for each in history.interactions]
    for path, seed in zip(kept, range(2), strict=True):
        np.testing.assert_array_equal(read_scan(path).points, points(seed))
    with pytest.raises(UsageError, match="leave out --topic, --at and --frame"):
        session.step(kept[0], at=1)
    with pytest.raises(UsageError, match="intrinsics of its cameras"):
        Session(policy_of(), files, points=128, lens=Lens(intrinsics=LENS)).step(recording)


@pytest.mark.slow
def test_what_is_no_recording_is_refused_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    whole = ROS.write(tmp_path / "drive", [("/points", 0, ROS.cloud(points()))]) / "drive.mcap"
    (tmp_path / "cut.mcap").write_bytes(whole.read_bytes()[:60])
    (tmp_path / "other.mcap").write_bytes(b"no recording")
    (tmp_path / "empty").mkdir()
    (tmp_path / "empty" / "metadata.yaml").touch()
    for path, expected in (
        (tmp_path / "cut.mcap", "holds no message; it was cut off"),
        (tmp_path / "other.mcap", "damaged, cut off, or no recording of ROS 2"),
        (tmp_path / "empty", "a folder without a file of a recording"),
        (tmp_path / "missing.db3", "no such recording"),
    ):
        flags = ["--cloud", str(path), "--history", str(tmp_path / "h.json"), "--policy", "push-faucet"]
        assert adaafford(["adapt", *flags]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert str(path) in line and expected in line
    assert not (tmp_path / "h.json").exists()


def long_drive(folder: Path, storage: str, packing: str, first: int = 0) -> Path:
    """Three large clouds, 30 s apart, in a chunk each."""
    said = [("/points", 30.0 * k, ROS.cloud(points(k, 100_000), stamp=30.0 * k)) for k in range(first, first + 3)]
    (file,) = [f for f in ROS.write(folder, said, storage, packing).iterdir() if f.name != "metadata.yaml"]
    return file


@pytest.mark.parametrize("packing", ["", "zstd", "lz4", "none"])
def test_of_a_recording_that_was_cut_off_what_is_whole_is_read(packing: str, tmp_path: Path) -> None:
    data = long_drive(tmp_path / "drive", "mcap", packing).read_bytes()
    summary = data.index(b"\x89MCAP0\r\n", 8)
    cut = tmp_path / "cut.mcap"
    # Without an end; in the last chunk; behind it nothing but zeros, as some file systems leave them.
    for size, last, zeros in ((summary - 1, 2, 0), (len(data) * 4 // 5, 1, 0), (len(data) * 3 // 5, 0, 5000)):
        cut.write_bytes(data[:size] + bytes(zeros))
        held, line = scan_of(cut, Selection())
        np.testing.assert_array_equal(parse_scan(held, cut, kind=".npz").points, points(last, 100_000))
        assert "cut.mcap, not closed by its recorder" in line
        np.testing.assert_array_equal(taken(cut, at=0).points, points(0, 100_000))


@pytest.mark.parametrize(
    ("storage", "packing"), [("mcap", "zstd"), ("sqlite3", ""), ("mcap", "file"), ("sqlite3", "file")]
)
def test_a_folder_of_several_files_is_one_recording_with_metadata_or_without(
    storage: str, packing: str, tmp_path: Path
) -> None:
    folder = tmp_path / "drive"
    folder.mkdir()
    for number in range(11):
        said = [("/points", 10.0 * number, ROS.cloud(points(number)))]
        if number == 0:
            said.append(("/tf_static", 0, ROS.transforms(ROS.transform("base", OPTICAL, (1, 2, 3)))))
        for file in ROS.write(tmp_path / f"part-{number}", said, storage, packing).glob("part-*"):
            file.rename(folder / file.name.replace("part-", "drive_"))
    np.testing.assert_array_equal(taken(folder).points, points(10), "10 is after 9")
    np.testing.assert_array_equal(taken(folder, at=75).points, points(7))
    np.testing.assert_allclose(taken(folder, frame="base").points, points(10) + np.array([1, 2, 3]), atol=1e-6)
    assert is_recording(folder)
    if packing == "file":
        (file,) = folder.glob("drive_3.*")
        np.testing.assert_array_equal(taken(file).points, points(3))
        assert is_recording(file)
        file.write_bytes(file.read_bytes()[:30])
        with pytest.raises(UsageError, match="holds no message; it was cut off"):
            taken(file)
        np.testing.assert_array_equal(taken(folder, at=35).points, points(2))


def test_messages_in_the_log_of_an_sqlite_file_that_was_not_closed_are_read(tmp_path: Path) -> None:
    whole = next(ROS.write(tmp_path / "whole", [("/points", 0, ROS.cloud(points(0)))], "sqlite3").glob("*.db3"))
    last = next(ROS.write(tmp_path / "last", [("/points", 9, ROS.cloud(points(1)))], "sqlite3").glob("*.db3"))
    with closing(sqlite3.connect(whole)) as database, closing(sqlite3.connect(last)) as other:
        database.execute("PRAGMA journal_mode=WAL")
        database.executemany(
            "INSERT INTO messages VALUES (99, ?, ?, ?)", other.execute("SELECT topic_id, timestamp, data FROM messages")
        )
        database.commit()
        killed = tmp_path / "killed"
        killed.mkdir()
        for end in ("", "-wal"):
            (killed / f"drive_0.db3{end}").write_bytes(whole.with_name(whole.name + end).read_bytes())
    held, line = scan_of(killed / "drive_0.db3", Selection())
    np.testing.assert_array_equal(parse_scan(held, killed, kind=".npz").points, points(1))
    assert "not closed by its recorder" in line
    # What is damaged was not committed.
    log = bytearray((killed / "drive_0.db3-wal").read_bytes())
    log[-1] ^= 1
    (killed / "drive_0.db3-wal").write_bytes(log)
    np.testing.assert_array_equal(taken(killed).points, points(0))


@settings(max_examples=60)
@given(place=st.integers(0, 1 << 16), value=st.integers(0, 255), cut=st.booleans(), mcap=st.booleans())
def test_a_damaged_recording_raises_and_never_hangs(
    tmp_path_factory: pytest.TempPathFactory, place: int, value: int, cut: bool, mcap: bool
) -> None:
    folder = tmp_path_factory.getbasetemp() / f"whole-{mcap}"
    if not folder.exists():
        ROS.write(folder, [("/points", 0, ROS.cloud(points()))], "mcap" if mcap else "sqlite3")
    (file,) = [*folder.glob("*.mcap"), *folder.glob("*.db3")]
    data = bytearray(file.read_bytes())
    data[place % len(data)] = value
    damaged = folder.parent / f"damaged{file.suffix}"
    damaged.write_bytes(data[: place % len(data)] if cut else data)
    with suppress(Exception):  # Of the library; the process makes a line of it.
        taken(damaged)


@pytest.mark.slow
def test_a_chunk_that_unpacks_to_gigabytes_is_refused(tmp_path: Path) -> None:
    file = ROS.write(tmp_path / "drive", [("/points", 0, ROS.cloud(points()))], packing="bomb") / "drive.mcap"
    with pytest.raises(UsageError, match="needs more than 2048 MB to unpack"):
        read_scan(file)


def test_a_recording_without_its_reader_says_how_to_get_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = extras_module.find_spec
    monkeypatch.setattr(extras_module, "find_spec", lambda name: None if name == "rosbags" else found(name))
    with pytest.raises(UsageError, match=r"needs rosbags, not installed here: pip install 'adaafford\[ros\]'"):
        read_scan(tmp_path / "drive.mcap")


def test_a_follower_may_ask_for_a_time_of_a_recording() -> None:
    from adaafford.sessions import Request

    assert Request.read(json.dumps({"cloud": "drive.mcap", "at": 3.5}).encode()).at == 3.5
    with pytest.raises(UsageError, match="at"):
        Request.read(b'{"cloud": "drive.mcap", "at": -1}')
