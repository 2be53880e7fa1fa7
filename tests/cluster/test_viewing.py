"""The viewer without a browser: what of a store is found, what policies believe, and which points clicks mark."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from adaafford import Store, read_scan
from adaafford.scans import checked_scan
from cluster.viewing.beliefs import Beliefs, Quantity, part_colours, told_before, value_colours
from cluster.viewing.browsing import Browser, Filters, choices
from cluster.viewing.scan_page import Eye, Marking
from shared.errors import UsageError
from shared.io import files
from shared.plan import Job, Plan, RolloutRecord
from shared.store.backends.base import is_url
from shared.types import OutcomeKind, Role
from tests.support.fabricate import fabricate_rollout, fabricate_rollouts, fabricate_setting, fabricate_store
from tests.support.small_policies import policy_of

RANDOM = Plan(setting=fabricate_setting())
PROPOSED = Plan(setting=fabricate_setting(), proposer="aip", policy_version=2)


@pytest.fixture(scope="module")
def made() -> dict[str, str]:
    """Where the store is of each kind of place, once there is one."""
    return {}


@pytest.fixture
def store(where: str, made: dict[str, str], tmp_path_factory: pytest.TempPathFactory) -> Store:
    """Seven rollouts of two plans in four shards, which tests only read."""
    kind = "bucket" if is_url(where) else "disk"
    if kind not in made:
        made[kind] = where if kind == "bucket" else str(tmp_path_factory.mktemp("viewing") / "store")
        store = Store.create(made[kind], RANDOM.setting)
        for plan, start, stop in ((RANDOM, 0, 2), (RANDOM, 2, 4), (RANDOM, 4, 5), (PROPOSED, 0, 2)):
            job = Job(plan.key, start, stop)
            store.commit(plan, job, fabricate_rollouts(plan, job), {})
    return Store.open(made[kind])


def everything(browser: Browser) -> list[tuple[str, int]]:
    found, number = [], 0
    while browser.has_page(number):
        found += [(match.plan, match.rollout) for match in browser.page(number)]
        number += 1
    return found


@pytest.mark.parametrize("page", [1, 2, 3, 7, 50])
def test_pages_of_any_size_show_each_rollout_once(store: Store, page: int) -> None:
    browser = Browser(store, page=page)
    wanted = [("aip-v2", 0), ("aip-v2", 1), *(("random-v0", k) for k in range(5))]
    assert everything(browser) == wanted
    # Back to a page that was read before.
    assert [match.rollout for match in browser.page(0)] == [rollout for _, rollout in wanted[:page]]
    assert not browser.has_page(-1) and not browser.has_page(-(-7 // page))


@pytest.mark.parametrize(
    "filters",
    [
        Filters(object_id="object-1"),
        Filters(outcome=OutcomeKind.WRONG_PART),
        Filters(success=True),
        Filters(proposer="aip", policy_version=2),
        Filters(policy_version=0, success=False),
        Filters(object_id="object-2", outcome=OutcomeKind.OK, success=True, proposer="random"),
        Filters(proposer="nobody"),
    ],
)
def test_rollouts_are_found_that_a_search_of_all_rows_finds(store: Store, filters: Filters) -> None:
    wanted = {}
    for part in store.parts():
        for rollout in store.read_rollouts(part.shard.shard_id):
            steps = tuple(row.step for row in rollout.interactions if meets(rollout, row, filters))
            if steps:
                wanted[rollout.plan_key, rollout.index] = steps
    found = Browser(store, filters).page(0)
    assert {(match.plan, match.rollout): match.steps for match in found} == wanted
    for match in found:
        rollout = Browser(store, filters).rollout(match)
        assert (rollout.plan_key, rollout.index, rollout.object.id) == (match.plan, match.rollout, match.object_id)
        assert match.successes == sum(rollout.interactions[step].outcome.success for step in match.steps)


def meets(rollout: RolloutRecord, row: object, filters: Filters) -> bool:
    assert hasattr(row, "outcome") and hasattr(row, "proposer") and hasattr(row, "policy_version")
    pairs = (
        (filters.object_id, rollout.object.id),
        (filters.outcome, row.outcome.kind),
        (filters.success, row.outcome.success),
        (filters.proposer, row.proposer),
        (filters.policy_version, row.policy_version),
    )
    return all(wanted is None or wanted == has for wanted, has in pairs)


def test_a_page_reads_no_more_shards_than_it_needs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store, read = fabricate_store(tmp_path / "store", 40), list[int]()
    selected = Store.selected

    def counting(self: Store, selection: object, parts: list[object]) -> object:
        read.append(len(parts))
        return selected(self, selection, parts)  # type: ignore[arg-type]

    monkeypatch.setattr(Store, "selected", counting)
    browser = Browser(store, page=4)
    assert len(browser.page(0)) == 4 and sum(read) == 8
    assert [match.rollout for match in browser.page(1)] == [4, 5, 6, 7] and sum(read) == 16


def test_choices_are_the_proposers_and_versions_of_all_plans(store: Store) -> None:
    assert choices(store) == (["aip", "random"], [0, 2])


def test_beliefs_are_those_of_the_adapter_and_change_with_interactions() -> None:
    rollout, policy = fabricate_rollout(RANDOM, 0), policy_of()
    row = rollout.interactions[3]
    history, before = told_before(rollout, row)
    assert (len(history), before) == (8, 3)
    observation = rollout.observations[row.observation]
    beliefs = Beliefs({"a": lambda: policy, "b": lambda: policy_of(seed=1)})
    beliefs.look_at(observation, history)
    values = beliefs.values("a", Quantity.AFFORDANCE, 3)
    from shared.policies.adaptation import Adapter

    wanted = Adapter(policy).affordance(observation, history[:3])
    assert values[observation.movable] == pytest.approx(wanted[observation.movable], abs=1e-6)
    assert beliefs.values("a", Quantity.AFFORDANCE, 3) is values, "kept"
    without = beliefs.values("a", Quantity.AFFORDANCE, 0)
    assert beliefs.values("a", Quantity.CHANGE, 3) == pytest.approx(values - without)
    assert not beliefs.values("a", Quantity.CHANGE, 0).any()
    for quantity in (Quantity.AFFORDANCE, Quantity.CHANGE, Quantity.PRIOR, Quantity.INFORMATION):
        low, high = beliefs.range_of(("a", "b"), quantity)
        for name in ("a", "b"):
            for known in (0, 8):
                seen = beliefs.values(name, quantity, known)[observation.movable]
                assert low - 1e-6 <= seen.min() and seen.max() <= high + 1e-6
    assert beliefs.range_of(("a",), Quantity.CHANGE)[0] == -beliefs.range_of(("a",), Quantity.CHANGE)[1]


def test_a_policy_is_told_what_its_own_method_did_and_no_measurement() -> None:
    rollout = fabricate_rollout(RANDOM, 0, interactions=6)
    roles = [Role.QUERY, Role.CONTEXT, Role.CONTEXT, Role.CONTEXT, Role.EXPLOIT, Role.EXPLOIT]
    methods = ["", "ours", "ours", "other", "ours", "other"]
    rows = [
        replace(row, role=role, method=method)
        for row, role, method in zip(rollout.interactions, roles, methods, strict=True)
    ]
    rows[2] = replace(rows[2], outcome=replace(rows[2].outcome, kind=OutcomeKind.ABANDONED))
    rollout = replace(rollout, interactions=tuple(rows))
    history, before = told_before(rollout, rows[4])
    assert [each.action for each in history] == [rows[1].action] and before == 1
    assert [each.action for each in told_before(rollout, rows[5])[0]] == [rows[3].action]


def test_colours_show_movable_parts_and_ends_of_a_range() -> None:
    observation = fabricate_rollout(RANDOM, 0).observations[0]
    colours = part_colours(observation)
    assert colours.shape == observation.points.shape
    assert len(np.unique(colours[observation.part_ids == 0], axis=0)) == 1
    values = np.array([0.0, 1.0, 0.5], np.float32)
    mask = np.array([True, True, False])
    low, high, grey = value_colours(values, (0.0, 1.0), mask, Quantity.AFFORDANCE).tolist()
    assert (low, high) == ([68, 1, 84], [253, 231, 37]) and grey == [150, 155, 162]
    assert value_colours(values, (-1.0, 1.0), mask, Quantity.CHANGE)[0].tolist() == [205, 205, 205]


def box_scan(**more: object) -> Marking:
    """The front and the top of a box, which meet at a right angle; the front is at x = 0."""
    across, up = (axis.ravel() for axis in np.meshgrid(np.linspace(0, 1, 41), np.linspace(0, 1, 41)))
    front = np.stack([np.zeros_like(up), across, up + 0.01], axis=1)
    top = np.stack([up + 0.025, across, np.full_like(up, 1.02)], axis=1)
    return Marking(checked_scan(np.concatenate([front, top]), **more))  # type: ignore[arg-type]


def test_a_click_marks_the_smooth_surface_that_the_eye_sees() -> None:
    marking = box_scan()
    point = marking.pick(np.array([-3.0, 0.5, 0.5]), np.array([1.0, 0.0, 0.0]))
    assert point is not None and marking.points[point] == pytest.approx([0.0, 0.5, 0.51], abs=0.02)
    surface = marking.region(point, 5.0, 15.0)
    front = marking.points[:, 0] == 0
    # Estimated normals are bent where the faces meet.
    assert surface[front].mean() > 0.9 and surface[~front].mean() < 0.1
    ball = marking.region(point, 0.2)
    assert (ball == (np.linalg.norm(marking.points - marking.points[point], axis=1) <= 0.2)).all()
    assert marking.pick(np.array([-3.0, 0.5, 5.0]), np.array([1.0, 0.0, 0.0])) is None
    assert marking.pick(np.array([-3.0, 0.5, 0.5]), np.array([-1.0, 0.0, 0.0])) is None, "behind the eye"


def test_a_box_of_the_screen_marks_what_is_seen_in_it() -> None:
    marking = box_scan()
    # From 1 m before the middle of the front, along +x; the right of the screen is towards -y.
    rotation = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    eye = Eye(np.array([-1.0, 0.5, 0.51]), rotation, np.pi / 2, 1.0)
    front = marking.points[:, 0] == 0
    assert marking.box(eye, (0.0, 0.0), (1.0, 1.0))[front].all()
    right, upper = marking.box(eye, (0.5, 0.0), (1.0, 1.0)), marking.box(eye, (0.0, 0.0), (1.0, 0.5))
    assert (right[front] == (marking.points[front, 1] <= 0.5)).all()
    assert (upper[front] == (marking.points[front, 2] >= 0.51)).all()
    wide = replace(eye, aspect=2.0)
    assert not marking.box(wide, (0.0, 0.0), (0.37, 1.0))[front].any(), (
        "0.5 of 2 from the middle is 0.375 from the edge"
    )
    assert not marking.box(replace(eye, place=np.array([2.0, 0.5, 0.5])), (0.0, 0.0), (1.0, 1.0)).any(), (
        "behind the eye"
    )


def test_marks_add_up_are_taken_away_and_undone() -> None:
    marking = box_scan()
    assert not marking.movable.any() and not marking.undo()
    one, other = marking.region(0, 0.2), marking.region(1000, 0.2)
    marking.mark(one, movable=True)
    marking.mark(other, movable=True)
    assert (marking.movable == one | other).all()
    marking.mark(one, movable=False)
    assert (marking.movable == other & ~one).all()
    assert marking.undo() and (marking.movable == one | other).all()
    assert marking.undo() and marking.undo() and not marking.movable.any()


def test_saved_marks_are_read_back_in_the_rows_of_the_scan(tmp_path: Path) -> None:
    whole = box_scan().scan.points
    rows = np.insert(whole, [3, 500], [[0.0, 0.0, 0.0]], axis=0)
    rows[900] = np.nan
    normals = np.tile([0.0, 0.0, 1.0], (len(rows), 1))
    marking = Marking(checked_scan(rows, normals, None, [2.0, 0.0, 1.0]))
    marking.mark(marking.region(10, 0.3), movable=True)
    count = marking.save(tmp_path / "marked.npz", overwrite=False)
    again = read_scan(tmp_path / "marked.npz")
    assert again.movable is not None and again.rows is not None and marking.scan.rows is not None
    assert (again.rows == marking.scan.rows).all() and again.missing == 3
    assert (again.points == marking.scan.points).all() and again.camera == (2.0, 0.0, 1.0)
    assert (again.movable == marking.movable).all() and again.movable.sum() == count
    # What was saved is what the next session begins with.
    assert (Marking(again).movable == marking.movable).all()


def test_a_large_scan_is_marked_by_a_sample_and_saved_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("cluster.viewing.scan_page.WORKING_POINTS", 800)
    marking = box_scan()
    assert len(marking.points) == 800
    marking.mark(marking.points[:, 0] == 0, movable=True)
    marking.save(tmp_path / "marked.npz", overwrite=False)
    again = read_scan(tmp_path / "marked.npz")
    assert again.movable is not None
    assert (again.movable == (again.points[:, 0] == 0)).mean() > 0.98


def test_nothing_is_overwritten_or_saved_in_vain(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    marking, out = box_scan(), tmp_path / "marked.npz"
    with pytest.raises(UsageError, match="no point is marked"):
        marking.save(out, overwrite=True)
    assert not out.exists()
    marking.mark(marking.region(10, 0.3), movable=True)
    out.write_bytes(b"mine")
    with pytest.raises(UsageError, match="is there already"):
        marking.save(out, overwrite=False)
    assert out.read_bytes() == b"mine"
    with pytest.raises(UsageError, match="cannot be written"):
        marking.save(tmp_path / "absent" / "marked.npz", overwrite=False)

    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as disk:
        disk.setattr(files, "write_durably", full)
        with pytest.raises(UsageError, match="No space left"):
            marking.save(out, overwrite=True)
    assert [path.name for path in tmp_path.iterdir()] == ["marked.npz"] and out.read_bytes() == b"mine"
    marking.save(out, overwrite=True)
    assert read_scan(out).movable is not None
