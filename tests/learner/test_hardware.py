"""What training runs on, and what it says of it."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

from learner.settings import LearnerConfig, TrainingConfig
from learner.training import data_parallel
from learner.training.hardware import Hardware, choose_device, hardware, moved
from learner.training.loop import ParameterGroup, StepResult, train
from learner.training.trackers import EventFiles
from shared.errors import UsageError

without_cuda = pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")


class Line:
    """A line is fitted to points of one."""

    name = "line"

    def __init__(self) -> None:
        self.module: nn.Module = nn.Linear(4, 1)
        self.seen: list[torch.dtype] = []

    def parameter_groups(self) -> list[ParameterGroup]:
        return [ParameterGroup(tuple(self.module.parameters()))]

    def loss(self, rng: np.random.Generator) -> StepResult:
        x = torch.as_tensor(rng.standard_normal((64, 4)), dtype=torch.float32)
        predicted = self.module(x)
        self.seen.append(predicted.dtype)
        return StepResult({"square": (predicted[:, 0].float() - x.sum(dim=1)).square().mean()}, 64)

    def validate(self) -> dict[str, float]:
        return {"score": self.loss(np.random.default_rng(0)).losses["square"].item()}


def test_the_device_is_said_in_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    with hardware(LearnerConfig(device="cpu", threads=torch.get_num_threads())) as found:
        assert found.device == torch.device("cpu")
    assert capsys.readouterr().out.startswith("device: cpu (")
    assert Hardware(bf16=True).describe().endswith(", bf16")


@without_cuda
def test_a_device_that_is_not_there_is_refused() -> None:
    assert choose_device("auto").type in ("cpu", "mps")
    for name in ("cuda", "cuda:3"):
        with pytest.raises(UsageError, match=f"device '{name}': PyTorch sees 0 CUDA devices"):
            choose_device(name)


@pytest.mark.parametrize("name", ["gpu", "cuda:", "cpu:1", "cuda:-1"])
def test_a_device_must_have_a_known_name(name: str) -> None:
    with pytest.raises(ValueError, match="device"):
        LearnerConfig(device=name)


def test_products_in_bf16_leave_weights_in_fp32_and_still_learn(tmp_path: Path) -> None:
    torch.manual_seed(0)
    stage = Line()
    config = TrainingConfig(steps=150, learning_rate=0.05, validate_every=50)
    result = train(stage, config, 0, tmp_path, hardware=Hardware(bf16=True), silent=True)
    assert set(stage.seen) == {torch.bfloat16, torch.float32}
    assert {parameter.dtype for parameter in stage.module.parameters()} == {torch.float32}
    assert result.metrics["score"] < 0.1


def test_moving_reaches_every_tensor_and_nothing_else() -> None:
    @dataclasses.dataclass(frozen=True)
    class Nested:
        tensors: tuple[torch.Tensor, ...]
        names: tuple[str, ...]
        inner: "Nested | None"

    value = Nested((torch.ones(2), torch.zeros(3)), ("a",), Nested((torch.ones(1),), (), None))
    there = moved(value, torch.device("meta"))
    assert all(tensor.is_meta for tensor in (*there.tensors, *there.inner.tensors))
    assert there.names == ("a",)
    assert there.inner.inner is None


def test_one_process_has_the_whole_batch() -> None:
    assert (data_parallel.processes(), data_parallel.rank()) == (1, 0)
    assert list(range(7))[data_parallel.share(7)] == list(range(7))
    assert data_parallel.shared_mean(torch.tensor(6.0), torch.tensor(4.0)) == 1.5
    assert data_parallel.shared_mean(torch.tensor(0.0), torch.tensor(0.0)) == 0.0


def test_event_files_are_what_tensorboard_reads(tmp_path: Path) -> None:
    pytest.importorskip("tensorboard")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    train(Line(), TrainingConfig(steps=4, validate_every=2), 0, tmp_path, silent=True)
    events = EventAccumulator(str(tmp_path / "tensorboard")).Reload()
    assert [event.step for event in events.Scalars("line/score")] == [2, 4]
    assert "line/loss_square" in events.Tags()["scalars"]


def test_without_tensorboard_nothing_is_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("learner.training.trackers.find_spec", lambda name: None)
    viewer = EventFiles(tmp_path / "events", 0)
    viewer.add(1, {"line/score": 1.0})
    assert not (tmp_path / "events").exists()
