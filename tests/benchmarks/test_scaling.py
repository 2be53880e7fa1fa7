"""The benchmark of scaling: its arithmetic, the stores that it makes up, and the actors that sleep."""

import asyncio
import dataclasses
import json
from pathlib import Path

import pytest

from benchmarks.listing import ListingBenchmark, StorePoint
from benchmarks.scaling import Line, ScaleSettings, Wish, WorkerGroupPoint, measure, predict, predictions
from benchmarks.scaling_figure import draw
from benchmarks.script import run_script
from benchmarks.sleeping import Dormitory, Sleeper
from shared.plan import Job, Plan
from shared.store import Store
from tests.support.fabricate import fabricate_rollouts, fabricate_setting

SETTING = fabricate_setting()
PLAN = Plan(setting=SETTING)
WISH = Wish(actors=1000, interactions=10**6, per_rollout=32, interactions_per_s=100.0)


def scale(*args: str) -> int:
    return run_script("scaling", ScaleSettings, measure, list(args))


def point(job_s: float, driver_ms: float) -> WorkerGroupPoint:
    return WorkerGroupPoint("guest", 100, job_s, 100, 2.0, driver_ms, 0.1, 0.99, 200.0, 0.0)


@pytest.fixture
def template(tmp_path: Path) -> Store:
    store, job = Store.create(tmp_path / "template", SETTING), Job(PLAN.key, 0, 4)
    store.commit(PLAN, job, fabricate_rollouts(PLAN, job), {})
    return store


def test_a_line_goes_through_what_lies_on_one() -> None:
    line = Line.through([(1.0, 3.0), (2.0, 5.0), (10.0, 21.0)])
    assert (line.at_zero, line.slope) == (pytest.approx(1.0), pytest.approx(2.0))
    assert Line.through([(7.0, 3.0)])(1e6) == 3.0


def test_larger_shards_unburden_the_driver_in_proportion() -> None:
    small, large = (predict(Line(2.0, 0.0), Line(0.0, 1e-5), WISH, per_shard) for per_shard in (5, 50))
    assert small.job_s == pytest.approx(1.6)
    assert small.driver_load == pytest.approx(1000 / 1.6 * 2e-3)
    assert small.most_actors == pytest.approx(800)
    assert large.driver_load == pytest.approx(small.driver_load / 10)
    assert (small.shards, large.shards) == (6250, 625)
    assert large.start_s == pytest.approx(625e-5)


def test_noise_that_makes_the_large_look_cheap_is_not_believed() -> None:
    stores = [StorePoint(10, 0.1, 0.0, None, 1.0, 1.0)]
    found = predictions([point(10, 2.0), point(100, 1.0)], stores, WISH)
    assert found["driver_ms_by_job_s"] == {"at_zero": 2.0, "slope": 0.0}
    rising = predictions([point(10, 1.0), point(110, 2.0)], stores, WISH)
    assert rising["driver_ms_by_job_s"]["slope"] == pytest.approx(0.01)


def test_actors_with_a_process_lift_the_prediction() -> None:
    stores = [StorePoint(10, 0.1, 0.0, None, 1.0, 1.0)]
    worker_groups = [point(10, 1.0), point(110, 2.0), dataclasses.replace(point(60, 2.5), kind="process")]
    assert predictions(worker_groups, stores, WISH)["driver_ms_by_job_s"]["at_zero"] == pytest.approx(0.9 + 1.0)


@pytest.mark.slow
def test_a_made_up_store_is_listed_as_a_real_one_and_takes_further_shards(template: Store, tmp_path: Path) -> None:
    turns = []
    benchmark = ListingBenchmark(template, tmp_path / "large", [3, 40])
    benchmark.run(lambda: turns.append(1))
    assert len(turns) == benchmark.turns == 2
    assert [each.shards for each in benchmark.points] == [3, 40]
    assert all(each.start_s > 0 and each.commit_ms > 0 and each.manifest_ms for each in benchmark.points)
    store = Store.open(tmp_path / "large")
    assert store.jobs() == [Job(PLAN.key, 4 * k, 4 * k + 4) for k in range(54)]
    assert len(store.read_rollouts(store.jobs()[-1].shard_id)) == 4


def test_a_sleeper_leaves_heartbeats_and_a_job_result_of_all_its_rollouts() -> None:
    heartbeats: list[int | None] = []
    job_result = Sleeper(0.01).run(PLAN, Job(PLAN.key, 3, 6), {}, heartbeats.append)
    assert heartbeats == [3, 4, 5, None]
    assert (job_result.rollouts, job_result.interactions) == (3, 96)
    assert sum(job_result.outcomes.values()) == 96
    assert job_result.seconds["total"] >= 0.01


def test_guests_of_one_process_sleep_at_the_same_time_and_each_does_its_jobs_in_turn(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asleep, most, pause = 0, 0, asyncio.sleep

    async def sleep(seconds: float) -> None:
        nonlocal asleep, most
        asleep += 1
        most = max(most, asleep)
        await pause(seconds)
        asleep -= 1

    async def night() -> list[str]:
        dormitory, woken = Dormitory(0.01), list[str]()

        async def lie(bed: int, number: int) -> None:
            await dormitory.run(bed, Job(PLAN.key, number, number + 1))
            woken.append(f"{bed}-{number}")

        await asyncio.gather(*(lie(bed, number) for number in range(2) for bed in range(20)))
        return woken

    monkeypatch.setattr(asyncio, "sleep", sleep)
    woken = asyncio.run(night())
    assert most == 20
    assert all(woken.index(f"{bed}-0") < woken.index(f"{bed}-1") for bed in range(20))


def test_sizes_out_of_order_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert scale("--shards", "100", "10") == 2
    assert "in order" in capsys.readouterr().err


def test_a_figure_that_cannot_be_kept_is_refused_beforehand(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    for figure in (tmp_path, tmp_path / "figure.foo", tmp_path / "nowhere" / "figure.png"):
        assert scale("--figure", str(figure)) == 2
        assert f"--figure {figure}: " in capsys.readouterr().err


@pytest.mark.slow
def test_the_benchmark_from_end_to_end(tmp_path: Path, template: Store, capsys: pytest.CaptureFixture[str]) -> None:
    sizes = ["--actors", "5", "120", "--processes", "2", "--shards", "10", "20", "--seconds", "1"]
    out = ["--figure", str(tmp_path / "figure.png"), "--out", str(tmp_path), "--json"]
    assert scale("--store", str(template.path), *sizes, *out) == 0
    result = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert [(each["kind"], each["actors"]) for each in result["fleets"]] == [
        ("guest", 5),
        ("guest", 120),
        ("process", 2),
    ]
    assert all(each["driver_ms"] > 0 and 0.1 < each["ideal_share"] <= 1.0 for each in result["fleets"])
    kept = next(tmp_path.glob("*-scaling-*.json"))
    draw(result, json.loads(kept.read_text())["result"], tmp_path / "again.png")
    assert (tmp_path / "figure.png").stat().st_size > 10_000
