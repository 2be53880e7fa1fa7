"""The viewer's server and pages: who may talk to it, what its controls do, and what a browser draws."""

import io
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from adaafford import Store, read_scan
from adaafford.scans import ScanFrame, checked_scan
from cluster.cli.main import run as adaafford
from shared.plan import Job, Plan, Setting
from tests.support.browser import CHROMIUM, browsing
from tests.support.fabricate import fabricate_rollouts, fabricate_setting
from tests.support.finished_run import make_finished_run
from tests.support.small_policies import policy_of

viser = pytest.importorskip("viser", reason="the viewer needs viser: pip install 'adaafford[view]'")

from cluster.cli.commands.view import ViewCommand, viewing  # noqa: E402
from cluster.viewing.scan_page import ScanPage  # noqa: E402
from cluster.viewing.server import serving  # noqa: E402
from cluster.viewing.store_page import StorePage  # noqa: E402

HOSTILE = "<img src=x onerror=\"document.title='taken'\">{alert(1)}"


def make_store(path: Path, category: str = "Faucet") -> Store:
    """Four rollouts of two plans, all of one object of some category."""
    setting = fabricate_setting(objects=1)
    ref = setting.objects[0].model_copy(update={"category": category})
    setting = Setting.model_validate({**setting.model_dump(), "objects": (ref.model_dump(),)})
    store = Store.create(path, setting)
    for plan in (Plan(setting=setting), Plan(setting=setting, proposer="aip", policy_version=1)):
        job = Job(plan.key, 0, 2)
        store.commit(plan, job, fabricate_rollouts(plan, job), {})
    return store


@pytest.fixture
def server() -> Iterator[Any]:
    with serving(0) as server:
        yield server


@pytest.fixture
def page(server: Any, tmp_path: Path) -> StorePage:
    """The page of a store, with two policies."""
    policies = {"first": policy_of, "second": lambda: policy_of(seed=1)}
    return StorePage(server, {"store": make_store(tmp_path / "store", HOSTILE)}, policies, ("first",), None)


def bad(args: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    assert adaafford(["view", *args]) == 2
    out, err = capsys.readouterr()
    assert out == "" and err.count("\n") == 1 and "Traceback" not in err
    return err


def test_bad_arguments_are_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    store = make_store(tmp_path / "store").where
    scan = tmp_path / "scan.npz"
    np.savez(scan, points=np.random.default_rng(0).uniform(1, 2, (100, 3)))
    (tmp_path / "scan-marked.npz").touch()
    (tmp_path / "broken.npz").write_bytes(b"PK")
    assert "is there already" in bad([str(scan)], capsys)
    assert "ends with .npz" in bad([str(scan), "--out", "marks.ply"], capsys)
    assert "is a scan" in bad([str(scan), "--objects", str(tmp_path)], capsys)
    assert "not readable as NPZ" in bad([str(tmp_path / "broken.npz")], capsys)
    assert "there is no such file" in bad([str(tmp_path / "absent.ply")], capsys)
    assert "is no scan" in bad([store, "--out", "marks.npz"], capsys)
    assert "no such folder" in bad([store, "--objects", str(tmp_path / "absent")], capsys)
    assert "no policy" in bad([store, "--policy", "nobody"], capsys)
    other = "--policy pull: a policy for 'pull', but the store is of 'push'; name one of this task"
    assert other in bad([store, "--policy", "pull"], capsys)
    assert "at most 2" in bad([store, "--policy", "a", "b", "c"], capsys)
    assert "allowed are 0 to 65535" in bad([store, "--port", "70000"], capsys)


def test_what_is_no_store_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for target in (tmp_path / "absent", tmp_path):
        assert adaafford(["view", str(target)]) != 0
        assert capsys.readouterr().err.count("\n") == 1


def test_a_port_in_use_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = str(other.getsockname()[1])
        assert f"port {port} of 127.0.0.1 cannot be used" in bad(
            [make_store(tmp_path / "store").where, "--port", port], capsys
        )


@pytest.mark.slow
def test_only_pages_of_this_machine_may_talk_to_the_server(server: Any) -> None:
    from websockets.exceptions import InvalidStatus
    from websockets.sync.client import connect

    port, protocols = server.get_port(), [f"viser-v{viser.__version__}"]
    address = f"ws://127.0.0.1:{port}"
    for origin in (f"http://127.0.0.1:{port}", "http://localhost:9000"):
        with connect(address, origin=origin, subprotocols=protocols) as connection:  # type: ignore[arg-type]
            assert connection.recv(timeout=60)
    for origin in ("http://example.org", "http://127.0.0.1.example.org", "null"):
        with pytest.raises(InvalidStatus, match="403"):
            connect(address, origin=origin, subprotocols=protocols)  # type: ignore[arg-type]
    names = {kind.__name__ for kind in server._websock_server._incoming_handlers}
    assert not any("Share" in name for name in names), "it cannot be made public"
    with socket.socket() as probe, pytest.raises(OSError, match="refused"):
        probe.connect((socket.gethostbyname(socket.gethostname()).replace("127.0.0.1", "127.0.0.2"), port))


@pytest.mark.slow
def test_filters_pages_and_steps_change_what_is_shown(page: StorePage) -> None:
    assert page.object.options == ("any", "object-0")
    assert page.proposer.options == ("any", "aip", "random") and page.version.options == ("any", "0", "1")
    assert len(page.rollout.options) == 4 and page.step.max == 8
    page.proposer.value = "random"
    assert len(page.rollout.options) == 2 and all("random" in name for name in page.rollout.options)
    page.success.value = "success"
    match = page._matches[page.rollout.value]
    assert page.row.step == match.steps[0] and page.row.outcome.success
    assert "success" in page.facts.content and "match" in page.facts.content
    seen = []
    for _ in range(20):
        seen.append((page.rollout.value, page.row.step))
        page._jump(1)
    wanted = [(name, step) for name, match in page._matches.items() for step in match.steps]
    assert list(dict.fromkeys(seen)) == wanted
    page._jump(-1)
    assert (page.rollout.value, page.row.step) == wanted[-2]
    page.outcome.value = "unstable"
    assert page.rollout.options == ("none",) and "No interaction" in page.facts.content
    page._jump(1)
    page._draw()
    page.outcome.value = "any"
    assert page.row.outcome.success
    page._open_page(5)
    assert "last page" in page.status.content


@pytest.mark.slow
def test_the_scene_holds_cloud_hand_and_the_known_interactions(page: StorePage, server: Any) -> None:
    nodes = server.scene._handle_from_node_name
    page.step.value = 5
    assert page.known.value == 4 and "of 8 interactions" in page.scale.content
    cloud = nodes["/panel0/cloud"]
    assert (cloud.points == page._observation().points.astype(cloud.points.dtype)).all()
    assert nodes["/panel0/action"].points[0, 1] == pytest.approx(page.row.action.point, abs=1e-5)
    assert len(nodes["/panel0/known"].points) == 4
    before = cloud.colors.copy()
    page.known.value = 0
    assert "/panel0/known" not in nodes and (nodes["/panel0/cloud"].colors != before).any()
    page.other.value = "second"
    assert (nodes["/panel1/cloud"].colors != nodes["/panel0/cloud"].colors).any()
    page.quantity.value = "parts"
    assert "/panel1" not in nodes
    page.cloud.value = False
    assert "/panel0/cloud" not in nodes


@pytest.mark.slow
def test_text_of_a_store_is_no_html(page: StorePage) -> None:
    assert "&lt;img src=x" in page.facts.content and "<img" not in page.facts.content


@pytest.mark.slow
def test_clicks_on_a_scan_mark_and_save(server: Any, tmp_path: Path) -> None:
    points = np.random.default_rng(0).uniform([1.0, -0.5, 0.0], [1.001, 0.5, 1.0], (3000, 3))
    scan, out = checked_scan(points, camera=[0.0, 0.0, 0.5]), tmp_path / "marked.npz"
    page = ScanPage(server, scan, ScanFrame.around(scan), out, overwrite=False, policy=policy_of())
    page.on(page.normals, call=page._save)
    page.normals.value = True
    assert "no point is marked" in page.status.content and not out.exists()
    page.click((0.0, 0.0, 0.5), (0.0, 0.0, 1.0))
    assert "no point is there" in page.status.content
    page.tool.value, page.radius.value = "ball", 0.2
    page.click((0.0, 0.0, 0.5), (1.0, 0.0, 0.0))
    marked = int(page.marking.movable.sum())
    assert 0 < marked < 1000 and f"{marked} of 3000" in page.facts.content
    page.affordance.value = True
    assert "affordance" in page.scale.content
    page._save()
    assert read_scan(out).movable is not None and f"saved {marked}" in page.status.content
    page.movable.value = False
    page.radius.value = 0.1
    page.click((0.0, 0.0, 0.5), (1.0, 0.0, 0.0))
    page._save()
    again = read_scan(out).movable
    assert again is not None and 0 < again.sum() < marked


@pytest.mark.slow
def test_a_run_brings_its_stores_policies_and_objects(tmp_path: Path) -> None:
    run = make_finished_run(tmp_path / "run", objects=2)
    with viewing(ViewCommand(str(run.path), port=0)) as server:
        labels = {getattr(handle, "label", "") for handle in server.gui._gui_input_handle_from_uuid.values()}
        assert {"Policy", "Compare with"} <= labels
    run.generated_objects.rename(tmp_path / "elsewhere")
    with viewing(ViewCommand(str(run.path), port=0)):
        pass  # Only the simulation needs objects.


@pytest.fixture(scope="module")
def collected(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store of one procedural cabinet with two interactions, and its objects beside it."""
    where = tmp_path_factory.mktemp("collected") / "store"
    args = ["--task", "pull-closed-door", "--rollouts", "1", "--workers", "0", "--collection.rollout.interactions", "2"]
    assert adaafford(["collect", "--store", str(where), *args]) == 0
    return where


@pytest.mark.slow
def test_an_interaction_is_played_as_it_was_simulated(server: Any, collected: Path) -> None:
    page = StorePage(server, {"store": Store.open(collected)}, {}, (), Path(f"{collected}-objects"))
    page._simulate()
    playback = page._playback
    assert playback is not None and "the same outcome as stored" in page.simulated.content
    bodies = playback.scenery().bodies
    assert len(page._moving) == len(bodies) and page.frame.max == len(playback.times) - 1
    for frame in (0, page.frame.max):
        page.frame.value = frame
        shown = np.stack([handle.position for handle in page._moving])
        assert shown == pytest.approx(playback.poses(frame)[:, :3, 3], abs=1e-6)
    page.frame.value = page.frame.max - 3
    page._play()
    assert page.frame.value == page.frame.max and not page._playing
    page.step.value = 2
    assert page._playback is None and page.play.disabled
    assert not any(name.startswith("/simulation") for name in server.scene._handle_from_node_name)


@pytest.mark.slow
def test_objects_that_are_not_there_are_one_line(server: Any, tmp_path: Path) -> None:
    page = StorePage(server, {"store": make_store(tmp_path / "store")}, {}, (), tmp_path)
    page.on(page.cloud, call=page._simulate)
    page.cloud.value = False
    assert "object-0" in page.status.content and page._playback is None


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="no chromium on this machine")
def test_a_browser_draws_the_store_and_asks_nobody_else(collected: Path, server: Any, tmp_path: Path) -> None:
    page = StorePage(server, {"store": Store.open(collected)}, {}, (), Path(f"{collected}-objects"))
    own = re.compile(rf"(https?|ws)://127\.0\.0\.1:{server.get_port()}(/|$)|data:|blob:")
    with browsing(tmp_path / "profile") as tab:
        tab.open(f"http://127.0.0.1:{server.get_port()}")
        tab.wait_for("document.querySelector('canvas') !== null && document.body.innerText.includes('pull')")
        cloud = drawn(tab)
        page._simulate()
        page.frame.value = page.frame.max
        mesh = drawn(tab, other_than=cloud)
        tab.run("1")
        assert tab.errors == []
        assert [address for address in tab.requested if not own.match(address)] == []
    assert np.abs(cloud - mesh).mean() > 1.0


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="no chromium on this machine")
def test_a_click_in_the_browser_marks_points(server: Any, tmp_path: Path) -> None:
    points = np.random.default_rng(0).uniform([2.0, -0.7, -0.7], [2.0, 0.7, 0.7], (4000, 3))
    scan = checked_scan(points)
    page = ScanPage(server, scan, ScanFrame.around(scan), tmp_path / "out.npz", overwrite=False, policy=None)
    with browsing(tmp_path / "profile") as tab:
        tab.open(f"http://127.0.0.1:{server.get_port()}")
        tab.wait_for("document.querySelector('canvas') !== null")
        # The controls take their place beside the canvas a moment after it is there.
        tab.wait_for("document.querySelector('canvas').clientWidth < innerWidth - 100")
        drawn(tab)
        x, y = tab.run(
            "(() => { const r = document.querySelector('canvas').getBoundingClientRect();"
            " return [r.x + r.width / 2, r.y + r.height / 2]; })()"
        )
        until_marked(page, lambda: tab.click(x, y))
        front = page.marking.movable
        page._undo()
        until_marked(page, lambda: tab.drag((x - 200, y - 200), (x, y), shift=True))
        # The upper left quarter of what is seen, from the origin along +x, so of larger y and z.
        some = points[page.marking.movable]
        assert front.mean() > 0.9 and 100 < len(some) < 2000 and some[:, 1:].min() > -0.05


def until_marked(page: ScanPage, act: Any) -> None:
    """Do what marks points until some are marked: a page that has just been drawn may not listen yet."""
    for _ in range(4):
        act()
        until = time.monotonic() + 20
        while time.monotonic() < until:
            if page.marking.movable.any():
                return
            time.sleep(0.1)
    raise AssertionError("nothing is marked")


def drawn(tab: Any, other_than: Any = None) -> Any:
    """The left half of the page, as soon as it shows something (other than before), [H, W, 3]."""
    until = time.monotonic() + 100
    while True:
        image = np.asarray(Image.open(io.BytesIO(tab.picture())).convert("RGB"), float)[150:, :700]
        if image.std() > 5 and (other_than is None or np.abs(image - other_than).mean() > 1.0):
            return image
        assert time.monotonic() < until, "the page stays blank"
        time.sleep(0.5)


@pytest.mark.slow
def test_ctrl_c_ends_the_viewer(tmp_path: Path) -> None:
    store = make_store(tmp_path / "store").where
    command = [sys.executable, "-m", "cluster", "view", store, "--port", "0"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stdout is not None
    first = process.stdout.readline()
    assert re.match(r"http://127\.0\.0\.1:\d+ shows it", first)
    assert "ssh -L" in process.stdout.readline()
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=100)
    assert (process.returncode, out, err) == (0, "the viewer has ended\n", "")
