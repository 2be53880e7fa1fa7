"""`adaafford train`: alone in its process, resumable whatever kills it, and not to be misled by damaged files."""

import hashlib
import json
import os
import random
import shutil
import signal
import subprocess
import sys
from contextlib import closing
from pathlib import Path

import psutil
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from pydantic import TypeAdapter
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from cluster.cli.main import INTERRUPTED, run
from cluster.runs.subprocesses import Child
from learner.alternation import ALTERNATION_FILE, Finished, alternate, converged
from learner.data.dataset import load_dataset
from learner.data.sampling import split, without_later
from learner.settings import METRICS_FILE, OUTPUT_FILE, AlternationConfig, LearnerConfig
from learner.stages.jobs import DONE_FILE, LOCK_FILE, StageJob, StageName, as_json, read_policy_folder, run_stage
from learner.training.hardware import Hardware
from learner.training.loop import CHECKPOINT_FILE
from shared.errors import UsageError, WorkerError
from shared.io.files import exclusive_lock
from shared.io.text import without_places
from shared.plan import Job, Plan
from shared.policies.policy import POLICY_FILE, WEIGHTS_FILE
from shared.progress import Progress
from shared.store.coverage import Snapshot
from shared.store.store import Store
from shared.tasks import Task
from tests.support.as_toml import as_toml
from tests.support.small_networks import TINY
from tests.support.small_trainings import FAST, fabricated_plan, fabricated_rollouts, make_store

ENVIRONMENT = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(Path(__file__).parents[2])}
EAGER = LearnerConfig.model_validate(
    FAST.model_dump()
    | {
        "threads": 1,
        "prior": FAST.prior.model_dump() | {"steps": 60, "validate_every": 20, "checkpoint_seconds": 0.0},
    }
)
"""Leaves a checkpoint after every step."""


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store with a round of random proposals and one that policy 1 proposed."""
    path = tmp_path_factory.mktemp("train") / "store"
    made = make_store(path)
    proposed = fabricated_plan().model_copy(update={"proposer": "aip", "policy_version": 1})
    made.add_plan(proposed)
    rollouts = fabricated_rollouts(proposed, 4)
    made.commit(proposed, Job(proposed.key, 0, 4), rollouts, {})
    return path


@pytest.fixture(scope="module")
def config_file(store: Path) -> Path:
    path = store.parent / "learner.toml"
    path.write_text(as_toml(EAGER.model_dump(mode="json")))
    return path


def contents(folder: Path) -> dict[str, str]:
    """The SHA-256 of every file in a folder."""
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def train_process(arguments: list[str], before: str = "") -> "subprocess.Popen[str]":
    script = f"import sys\n{before}\nfrom cluster.cli.main import run\nsys.exit(run(sys.argv[1:]))"
    command = [sys.executable, "-c", script, "train", *arguments]
    return subprocess.Popen(command, env=ENVIRONMENT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


REFUSE = """
class Refuse:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in ("ray", "sapien"):
            raise ModuleNotFoundError(f"there is no {name}")
sys.meta_path.insert(0, Refuse())
"""


def test_it_trains_without_ray_and_sapien(store: Path, config_file: Path, tmp_path: Path) -> None:
    arguments = ["prior", "--store", str(store), "--out", str(tmp_path / "out"), "--config", str(config_file)]
    out, err = train_process([*arguments, "--prior.steps", "1"], REFUSE).communicate(timeout=100)
    assert (err, out.splitlines()[0]) == ("", "device: cpu (1 thread)")
    assert f"leaves {WEIGHTS_FILE}, {POLICY_FILE} and {METRICS_FILE} in {tmp_path / 'out'}" in out
    assert (tmp_path / "out" / WEIGHTS_FILE).is_file()


def learners() -> list[psutil.Process]:
    """This process's children that train; other tests may have left it others."""
    living = [child for child in psutil.Process().children() if child.status() != psutil.STATUS_ZOMBIE]
    return [child for child in living if "cluster.cli.child" in child.cmdline()]


@pytest.mark.slow
def test_a_learner_goes_on_from_stage_to_stage_in_one_process(store: Path, tmp_path: Path) -> None:
    lines: list[str] = []

    def train(stage: StageName, init: str | None = None) -> None:
        job = StageJob(stage, store, tmp_path / stage, None if init is None else tmp_path / init)
        child.run("learner.stages.jobs:run_from_json", as_json(job, FAST.model_copy(update={"threads": 1})), job.out)

    with closing(Child(lines.append)) as child:
        train("prior")
        (one,) = learners()
        train("aap", "prior")
        assert learners() == [one], "the same process"
        with pytest.raises(UsageError, match="'aip' starts from a policy: add --init"):
            train("aip")
        assert not learners(), "ended by what failed"
        train("aip", "aap")
    assert not learners()
    assert read_policy_folder(tmp_path / "aip").trained == {"prior", "aap", "aip"}
    for stage in ("prior", "aap", "aip"):
        told = (tmp_path / stage / OUTPUT_FILE).read_text()
        assert f"'{stage}' for '{Store.open(store).setting.task}' is done" in told
        assert set(told.splitlines()) <= {without_places(line, tmp_path / stage) for line in lines}


def test_a_learner_that_is_killed_ends_the_stage(tmp_path: Path) -> None:
    """Whatever it does; here, something that it begins sooner than a training."""
    (tmp_path / "long.py").write_text("import time\nprint('begun', flush=True)\ntime.sleep(100)\n")

    def kill(line: str) -> None:
        assert line == "begun"
        for child in learners():
            child.kill()

    with closing(Child(kill)) as child, pytest.raises(WorkerError, match=rf"{tmp_path} ended with code -9"):
        child.run("runpy:run_path", {"path_name": str(tmp_path / "long.py")}, tmp_path)


def test_a_job_is_the_same_after_its_way_to_the_trainer(store: Path, tmp_path: Path) -> None:
    snapshot = Snapshot(ranges={"random-v0": ((0, 3),)})
    job = StageJob("aap", str(store), tmp_path, tmp_path / "prior", frozenset(("a b", "c")), None, snapshot, 2)
    config = EAGER.model_copy(update={"seed": 2**62 + 1})
    config = config.model_copy(
        update={"prior": config.prior.model_copy(update={"seconds": 0.1, "learning_rate": 1e-17})}
    )
    sent = json.loads(json.dumps(as_json(job, config)))
    assert TypeAdapter(StageJob).validate_python(sent["job"]) == job
    assert LearnerConfig.model_validate(sent["config"]) == config


def test_an_alternation_learns_round_by_round_and_goes_on_where_it_was_stopped(store: Path, tmp_path: Path) -> None:
    config = FAST.model_copy(update={"alternation": AlternationConfig(rounds=2)})
    job = StageJob("prior", store, tmp_path / "out")
    alternate(Finished(job), config)
    told = json.loads((job.out / ALTERNATION_FILE).read_text())
    assert [entry["round"] for entry in told["rounds"]] == [1, 2]
    assert told["best"] == min(told["rounds"], key=lambda entry: entry["score"])["round"]
    stages = ["prior", "aap-1", "aip-1", "aap-2", "aip-2"]
    weights = {name: (job.out / name / WEIGHTS_FILE).read_bytes() for name in stages}
    shutil.rmtree(job.out / "aip-2")
    (job.out / "aap-2" / DONE_FILE).unlink()
    stamp = (job.out / "aip-1" / WEIGHTS_FILE).stat().st_mtime_ns
    alternate(Finished(job), config)
    assert {name: (job.out / name / WEIGHTS_FILE).read_bytes() for name in stages} == weights
    assert (job.out / "aip-1" / WEIGHTS_FILE).stat().st_mtime_ns == stamp


def test_a_round_sees_no_row_of_a_later_policy(store: Path) -> None:
    dataset = load_dataset(Store.open(store), TINY)
    parts = split(dataset, None, None)
    assert {dataset.versions[number] for number in parts.train} == {0, 1}
    earlier = without_later(dataset, parts, 0)
    assert {dataset.versions[number] for number in earlier.train} == {0}
    assert earlier.validation == parts.validation
    with pytest.raises(UsageError, match="policy -1 or older"):
        without_later(dataset, parts, -1)


def test_rounds_end_when_they_bring_less_than_the_share() -> None:
    config = AlternationConfig(rounds=10, improvement=0.01, patience=2)
    assert not converged([], config, 1)
    assert not converged([1.0, 0.98, 0.98], config, 1)
    assert converged([1.0, 0.98, 0.979, 0.975], config, 1)
    assert not converged([1.0, 0.98, 0.979, 0.975], config, 5)
    assert not converged([1.0, 0.98, 0.979, 0.9], config, 1)


@given(st.lists(st.floats(0.01, 10.0), max_size=12), st.integers(1, 4), st.integers(1, 12))
def test_rounds_always_end_and_never_before_all_was_seen(scores: list[float], patience: int, rounds: int) -> None:
    config = AlternationConfig(rounds=rounds, patience=patience)
    if len(scores) >= rounds:
        assert converged(scores, config, 1)
    elif converged(scores, config, 3):
        assert len(scores) >= 3
        assert min(scores) >= 0.99 * min(scores[:-patience])


def damaged_checkpoint(path: Path, kind: str) -> None:
    """Damage a checkpoint in place."""
    if kind == "truncated":
        path.write_bytes(path.read_bytes()[:-1000])
        return
    if kind == "foreign":
        path.write_bytes(b"\x80\x04\x95 a pickle, perhaps")
        return
    with safe_open(path, framework="pt") as file:
        cursor = json.loads(file.metadata()["cursor"])
    tensors = load_file(path)
    name = next(name for name in tensors if name.startswith("module.encoder") and tensors[name].dim() == 2)
    if kind == "mis-shaped":
        tensors[name] = tensors[name][:-1].clone()
    elif kind == "not finite":
        tensors[name][0, 0] = torch.nan
    elif kind == "moments":
        tensors = {name: tensor for name, tensor in tensors.items() if not name.startswith("optimiser.0.exp")}
    elif kind == "older":
        del tensors[name]
        cursor["epoch"] = 3
    elif kind == "another run":
        cursor["fingerprint"] = "0" * 64
    save_file(tensors, path, metadata={"cursor": json.dumps(cursor)})


@pytest.fixture(scope="module")
def stopped(store: Path, config_file: Path) -> Path:
    """A folder of a stage that was stopped after some steps."""

    def stop(progress: Progress, done: int, most_left_s: float) -> None:
        if done == 3:
            raise KeyboardInterrupt

    out = store.parent / "stopped"
    arguments = ["--store", str(store), "--out", str(out), "--config", str(config_file)]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Progress, "show", stop)
        assert run(["train", "prior", *arguments]) == INTERRUPTED
    assert (out / CHECKPOINT_FILE).exists()
    return out


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        ("truncated", "not a checkpoint"),
        ("foreign", "not a checkpoint"),
        ("mis-shaped", "needs torch.float32"),
        ("not finite", "not finite"),
        ("moments", "'optimiser.0.exp_avg' is missing"),
        ("older", "not a checkpoint of this version (cursor: epoch"),
        ("another run", "other data or settings; choose another --out"),
    ],
)
def test_a_damaged_checkpoint_is_refused_in_one_line_and_left_alone(
    stopped: Path,
    store: Path,
    config_file: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    kind: str,
    message: str,
) -> None:
    out = tmp_path / "out"
    shutil.copytree(stopped, out)
    damaged_checkpoint(out / CHECKPOINT_FILE, kind)
    before = contents(out)
    assert run(["train", "prior", "--store", str(store), "--out", str(out), "--config", str(config_file)]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert str(out) in error
    assert message in error
    assert contents(out) == before


@pytest.fixture(scope="module")
def prior(store: Path) -> Path:
    """The folder of a stage that was trained."""
    out = store.parent / "prior"
    run_stage(StageJob("prior", store, out), FAST)
    return out


@pytest.mark.parametrize("damage", ["truncated", "foreign", "not finite", "older", "missing"])
def test_damaged_weights_are_refused_in_one_line(
    store: Path, prior: Path, config_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], damage: str
) -> None:
    first = tmp_path / "prior"
    shutil.copytree(prior, first)
    weights, document = first / WEIGHTS_FILE, first / POLICY_FILE
    if damage == "truncated":
        weights.write_bytes(weights.read_bytes()[:-100])
    elif damage == "missing":
        weights.unlink()
    elif damage == "older":
        document.write_text(document.read_text().replace('"schema_version": 1', '"schema_version": 0'))
    else:
        # Copies, since what is loaded lies in the file that is about to be overwritten.
        tensors = {name: tensor.clone() for name, tensor in load_file(weights).items()}
        next(iter(tensors.values())).fill_(torch.nan)
        save_file(tensors, weights) if damage == "not finite" else torch.save(tensors, weights)
        told = json.loads(document.read_text())
        told["weights_sha256"] = hashlib.sha256(weights.read_bytes()).hexdigest()
        document.write_text(json.dumps(told))
    capsys.readouterr()
    arguments = ["--store", str(store), "--out", str(tmp_path / "aap"), "--init", str(first)]
    assert run(["train", "aap", *arguments, "--config", str(config_file)]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "Traceback" not in error
    assert not (tmp_path / "aap").exists()


def test_a_damaged_shard_is_refused_in_one_line(
    store: Path, config_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    copy = tmp_path / "store"
    shutil.copytree(store, copy)
    table = next(copy.glob("shards/*/interactions.parquet"))
    table.write_bytes(table.read_bytes()[:-50])
    out = tmp_path / "out"
    assert run(["train", "prior", "--store", str(copy), "--out", str(out), "--config", str(config_file)]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "interactions.parquet" in error


def test_the_command_says_what_it_needs(capsys: pytest.CaptureFixture[str]) -> None:
    for arguments, message in ((["train"], "given nothing"), (["train", "app"], "given 'app'")):
        assert run(arguments) == 2
        assert message in capsys.readouterr().err
    assert run(["train", "--help"]) == 0
    with pytest.raises(SystemExit):
        run(["train", "aap", "--help"])
    assert "--aap.imitation" in capsys.readouterr().out


@pytest.mark.parametrize("command", [["train", "prior"], ["train", "alternate"], ["learn"]])
def test_a_folder_with_other_files_is_refused(
    command: list[str], store: Path, config_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "thesis.tex").write_text("x")
    assert run([*command, "--store", str(store), "--out", str(tmp_path), "--config", str(config_file)]) == 2
    assert capsys.readouterr().err == (
        f"adaafford: {tmp_path}: holds 'thesis.tex' and no training; name a new or an empty folder as --out\n"
    )
    assert not [path.name for path in tmp_path.iterdir() if not path.name.startswith((".", "thesis"))]


def test_a_training_starts_from_a_bundled_policy_by_name(
    store: Path, config_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    where = ["--store", str(store), "--out", str(tmp_path / "out"), "--config", str(config_file)]
    for name, said in (("pull", "a policy for 'pull', but the store is of"), ("./pull", "holds no policy.json")):
        assert run(["train", "aap", *where, "--init", name]) == 2
        assert said in capsys.readouterr().err


@pytest.mark.parametrize("stage", ["aip-2", "training/aip-2"])
def test_a_whole_run_as_a_start_is_answered_with_a_stage_of_it(
    stage: str, store: Path, config_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "run" / stage).mkdir(parents=True)
    (tmp_path / "run" / stage / "policy.json").touch()
    where = ["--store", str(store), "--out", str(tmp_path / "out"), "--config", str(config_file)]
    assert run(["train", "aap", *where, "--init", str(tmp_path / "run")]) == 2
    said = f"{tmp_path}/run: holds no policy.json; name a stage in it, such as {tmp_path}/run/{stage}, or a bundled"
    assert said in capsys.readouterr().err


@pytest.mark.slow
def test_every_stage_learns_in_bf16(store: Path, tmp_path: Path) -> None:
    before: Path | None = None
    for stage in ("prior", "aap", "aip"):
        job = StageJob(stage, store, tmp_path / stage, before)
        run_stage(job, FAST, Hardware(bf16=True))
        before = job.out
    lines = [json.loads(line) for line in (tmp_path / "prior" / METRICS_FILE).read_text().splitlines()]
    assert lines[-1]["score"] < lines[0]["score"]


def test_the_same_seed_gives_the_same_weights_and_another_seed_others(store: Path, prior: Path, tmp_path: Path) -> None:
    weights = [(prior / WEIGHTS_FILE).read_bytes()]
    for name, seed in (("same", FAST.seed), ("other", FAST.seed + 1)):
        run_stage(StageJob("prior", store, tmp_path / name), FAST.model_copy(update={"seed": seed}))
        weights.append((tmp_path / name / WEIGHTS_FILE).read_bytes())
    assert weights[0] == weights[1] != weights[2]


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_sigkill_at_any_moment_changes_no_bit(store: Path, config_file: Path, tmp_path: Path) -> None:
    def arguments(out: Path) -> list[str]:
        return ["prior", "--store", str(store), "--out", str(out), "--config", str(config_file)]

    whole, killed = tmp_path / "whole", tmp_path / "killed"
    undisturbed = train_process(arguments(whole))
    undisturbed.communicate(timeout=120)
    assert undisturbed.returncode == 0
    rng, kills = random.Random(5), 0
    while True:
        child = train_process(arguments(killed))
        assert child.stdout is not None
        for line in child.stdout:
            if "leaves" in line:  # Loaded: from here on it trains.
                break
        try:
            child.wait(rng.uniform(0.0, 0.4) if kills < 8 else 120)
        except subprocess.TimeoutExpired:
            child.send_signal(signal.SIGKILL)
            kills += 1
        child.communicate()
        if child.returncode == 0:
            break
    assert kills > 0
    assert (killed / WEIGHTS_FILE).read_bytes() == (whole / WEIGHTS_FILE).read_bytes()

    def lines(out: Path) -> list[dict[str, object]]:
        parsed = [json.loads(line) for line in (out / METRICS_FILE).read_text().splitlines()]
        return [{name: value for name, value in line.items() if "second" not in name} for line in parsed]

    assert lines(killed) == lines(whole)


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize("stage", ["prior", "aap"])
def test_two_processes_take_the_steps_of_one(store: Path, prior: Path, tmp_path: Path, stage: str) -> None:
    told = FAST.model_dump() | {"threads": 1}
    file = tmp_path / "learner.toml"
    file.write_text(as_toml(told))
    init = ["--init", str(prior)] if stage == "aap" else []
    together = ["-m", "torch.distributed.run", "--nproc-per-node", "2", "--master-addr", "127.0.0.1"]
    together += ["--master-port", str(20_000 + os.getpid() % 20_000)]
    for name, launcher in (("one", []), ("two", together)):
        arguments = ["-m", "cluster", "train", stage, "--store", str(store), "--out", str(tmp_path / name), *init]
        done = subprocess.run(
            [sys.executable, *launcher, *arguments, "--config", str(file)],
            env=ENVIRONMENT,
            capture_output=True,
            text=True,
            timeout=250,
        )
        assert done.returncode == 0, done.stderr[-2000:]
        assert done.stdout.count("device: cpu (1 thread)") == 1
        assert ("2 processes" in done.stdout) == (name == "two")
    one, two = (load_file(tmp_path / name / WEIGHTS_FILE) for name in ("one", "two"))
    apart = torch.cat([(two[name] - tensor).abs().float().flatten() for name, tensor in one.items()])
    assert apart.mean() < 1e-5
    # Adam makes whole steps of gradients that are all but rounding, so that a weight in a thousand may be off by some.
    assert (apart > 1e-4).float().mean() < 1e-3
    curves = [
        [json.loads(line) for line in (tmp_path / name / METRICS_FILE).read_text().splitlines()]
        for name in ("one", "two")
    ]
    assert len(curves[0]) == len(curves[1]) > 1
    for alone, shared in zip(*curves, strict=True):
        assert shared["loss_critic"] == pytest.approx(alone["loss_critic"], rel=1e-4)
        assert shared["score"] == pytest.approx(alone["score"], rel=1e-4)


def test_a_second_learner_in_the_same_folder_is_refused(
    store: Path, config_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    out.mkdir()
    told = ["train", "prior", "--store", str(store), "--out", str(out), "--config", str(config_file)]
    with exclusive_lock(out / LOCK_FILE):
        assert run(told) == 2
    assert "is in use by process" in capsys.readouterr().err
    assert not (out / WEIGHTS_FILE).exists()


def test_a_policy_records_the_task_that_its_store_defines(tmp_path: Path) -> None:
    lid = Task(name="pull-lid", primitive="pull", revolute_only=True)
    setting = fabricated_plan().setting.model_copy(update={"task": lid.name, "task_definition": lid})
    make_store(tmp_path / "store", plan=Plan(setting=setting))
    first = run_stage(StageJob("prior", tmp_path / "store", tmp_path / "first"), FAST)
    assert first.task_record == read_policy_folder(tmp_path / "first").task_record == lid
    # As an earlier version left it.
    for name, data in first.defined_as(None).to_files().items():
        (tmp_path / "first" / name).write_bytes(data)
    assert read_policy_folder(tmp_path / "first").task_record is None
    tuned = run_stage(StageJob("prior", tmp_path / "store", tmp_path / "tuned", tmp_path / "first"), FAST)
    assert tuned.task_record == lid


@pytest.mark.slow
def test_a_policy_is_of_the_hand_of_the_store_that_it_was_trained_from_last(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plan = fabricated_plan()
    setting = plan.setting
    collection = setting.collection.model_copy(update={"gripper": "suction"})
    suction = Plan(setting=setting.model_copy(update={"collection": collection}))
    for name, of in (("panda", plan), ("suction", suction)):
        make_store(tmp_path / name, plan=of)
    first = run_stage(StageJob("prior", tmp_path / "panda", tmp_path / "first"), FAST)
    assert first.gripper == "panda"
    capsys.readouterr()
    tuned = run_stage(StageJob("prior", tmp_path / "suction", tmp_path / "tuned", tmp_path / "first"), FAST)
    assert tuned.gripper == "suction"
    assert "was trained with the hand 'panda'; it is now trained with 'suction'" in capsys.readouterr().out
    assert read_policy_folder(tmp_path / "tuned").gripper == "suction"
