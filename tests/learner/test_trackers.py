"""Trackers: found by name, offline, and never worth a training."""

import json
import sys
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path

import pytest

from learner.settings import TrainingConfig
from learner.training.loop import train
from learner.training.trackers import TRACKERS, VARIABLE
from shared.errors import UsageError
from tests.learner.test_hardware import Line

STAND_IN = {
    "wandb": """
import json
import sys
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
Settings = dict
class Run:
    def __init__(self, **arguments):
        self.lines, self.arguments = [], arguments
    def define_metric(self, name, step_metric): pass
    def log(self, values):
        self.lines.append(values)
    def finish(self):
        said = {"mode": self.arguments["mode"], "lines": self.lines}
        Path(self.arguments["dir"], "logged.json").write_text(json.dumps(said))
init = Run
""",
    "mlflow": """
import json
import sys
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import SimpleNamespace
class MlflowClient:
    def __init__(self, tracking_uri):
        self.uri, self.lines = tracking_uri, []
    def get_experiment_by_name(self, name): return None
    def create_experiment(self, name): return "1"
    def create_run(self, experiment, run_name): return SimpleNamespace(info=SimpleNamespace(run_id="2"))
    def log_metric(self, run, name, value, step): self.lines.append({name: value, "line/step": step})
    def set_terminated(self, run):
        path = Path(self.uri.removeprefix("sqlite:///"))
        path.with_name("logged.json").write_text(json.dumps({"mode": "offline", "lines": self.lines}))
""",
}


def install(name: str, text: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = folder / f"{name}.py"
    path.write_text(text)
    spec = spec_from_file_location(name, path)
    assert spec is not None and spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    monkeypatch.setitem(sys.modules, name, module)


@pytest.mark.parametrize("name", STAND_IN)
def test_a_tracker_gets_the_figures_of_each_validation(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    install(name, STAND_IN[name], tmp_path, monkeypatch)
    for variable in ("WANDB_MODE", "MLFLOW_TRACKING_URI"):
        monkeypatch.delenv(variable, raising=False)
    monkeypatch.setenv(VARIABLE, f" {name},")
    train(Line(), TrainingConfig(steps=4, validate_every=2), 0, tmp_path, silent=True)
    logged = json.loads((tmp_path / "logged.json").read_text())
    assert logged["mode"] == "offline"
    scores = {line["line/step"]: line["line/score"] for line in logged["lines"] if "line/score" in line}
    kept = [json.loads(line) for line in (tmp_path / "metrics.jsonl").read_text().splitlines()]
    assert scores == {line["step"]: line["score"] for line in kept}


def test_a_tracker_that_fails_costs_nothing_but_itself(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    broken = STAND_IN["wandb"].replace("self.lines.append(values)", "raise OSError(28, 'full')")
    install("wandb", broken, tmp_path, monkeypatch)
    monkeypatch.setenv(VARIABLE, "wandb")
    assert train(Line(), TrainingConfig(steps=4, validate_every=2), 0, tmp_path, silent=True).steps == 4
    assert caplog.text.count("tracker wandb failed (OSError: [Errno 28] full); the training goes on") == 1
    assert not (tmp_path / "logged.json").exists()


def test_a_tracker_that_cannot_be_had_is_said_before_anything_is_trained(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert TRACKERS.names()[:3] == ["tensorboard", "wandb", "mlflow"]
    monkeypatch.setattr("shared.extras.find_spec", lambda name: None)
    for named, said in (
        ("wandb", r"the tracker wandb needs wandb, not installed here: pip install 'adaafford\[wandb\]'"),
        ("wandbb", "unknown tracker 'wandbb'; allowed: tensorboard, wandb, mlflow"),
    ):
        monkeypatch.setenv(VARIABLE, named)
        with pytest.raises(UsageError, match=said):
            train(Line(), TrainingConfig(steps=4), 0, tmp_path, silent=True)
