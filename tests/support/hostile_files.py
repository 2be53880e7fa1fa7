"""A process that tries hostile files one after another, so that a crash or a hang costs its batch alone.

    python -m tests.support.hostile_files SCRATCH SEED START STOP KIND

KIND is "store", "policy" or "run". For each mutant it prints a line when it begins, and one when it ends: "refused",
"survived", or what went wrong. No mutant may take more than a gigabyte of memory.
"""

import resource
import shutil
import sys
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import nn

from adaafford.pretrained import load_policy
from cluster.config.campaign_config import CampaignConfig
from cluster.runs.run_folder import RunFolder, find
from cluster.runs.run_log import RunLog
from cluster.runs.status_snapshot import snapshot_of
from learner.alternation import best_score, trained_in
from learner.data.dataset import load_dataset
from learner.data.sampling import read_object_list
from learner.rounds import _published, _read_snapshot
from learner.stages.jobs import objects_seen
from learner.training.checkpoint import Cursor, read_checkpoint, read_cursor, write_checkpoint
from shared.config import load_toml, parse
from shared.errors import AdaAffordError
from shared.networks.network_config import NetworkConfig
from shared.plan import Job, Plan
from shared.policies.policy import Policy
from shared.store import Store, info, verify
from shared.store.maintenance.repair import repair
from tests.support.fabricate import fabricate_rollouts, fabricate_setting
from tests.support.file_mutations import SEALS, mutant_of, pick, remove, replace_by_no_file, vouch

MEMORY = 1 << 30
LONGEST_MESSAGE = 800
NETWORK = NetworkConfig(
    centres=(16, 4),
    radii=(0.3, 0.8),
    neighbours=4,
    abstraction=((8,), (8,)),
    propagation=((8,), (8,)),
    feature_width=8,
    latent_width=8,
    surroundings=4,
)


def main() -> None:
    """Try the mutants that the command line names; of several kinds, each comes in its turn."""
    scratch, seed, start, stop, *kinds = sys.argv[1:]
    subjects = [Subject.make(kind, Path(scratch) / kind) for kind in kinds]
    limit_memory()
    for number in range(int(start), int(stop)):
        subject = subjects[number % len(kinds)]
        rng = np.random.default_rng([int(seed), number // len(kinds)])
        file = subject.choose(rng)
        print(f"begin {number} {file.relative_to(subject.path)}", flush=True)
        begun = time.perf_counter()
        result = subject.try_mutant(file, rng)
        print(f"end {number} {time.perf_counter() - begun:.2f} {result}", flush=True)


@dataclass(frozen=True, slots=True)
class Subject:
    """What is damaged, one file at a time.

    Attributes:
        sound: a folder as it should be.
        path: its copy, which is damaged and put right again.
        files: those that are damaged, relative to both.
        read: messages of everything that reads it.
        repair: messages of what is left after a repair, of what can be repaired.
    """

    sound: Path
    path: Path
    files: list[Path]
    read: Callable[[Path], list[str]]
    repair: Callable[[Path], list[str]] | None

    @classmethod
    def make(cls, kind: str, folder: Path) -> "Subject":
        """One of a kind, which is read without a complaint."""
        make, read, repair_too = {
            "store": (make_store, read_store, repair_store),
            "policy": (make_policy, read_policy, None),
            "run": (make_run, read_run, None),
        }[kind]
        folder.mkdir()
        sound, path = folder / "sound", folder / "x"
        make(sound)
        shutil.copytree(sound, path)
        assert verdict(lambda: read(path)) == "survived", verdict(lambda: read(path))
        files = sorted(file.relative_to(path) for file in path.rglob("*") if file.is_file() and file.name[0] != ".")
        if kind == "store":
            files = [file for file in files if "00000002-" not in str(file)]
        return cls(sound, path, files, read, repair_too)

    def choose(self, rng: np.random.Generator) -> Path:
        """A file; of a store's many files, those of each kind come equally often."""
        name = pick(rng, sorted({file.name for file in self.files}))
        return self.path / pick(rng, [file for file in self.files if file.name == name])

    def try_mutant(self, file: Path, rng: np.random.Generator) -> str:
        """The verdict on one damaged file."""
        damage(self.path, file, rng)
        result = verdict(lambda: self.read(self.path))
        if self.repair is not None and result.startswith("refused") and rng.random() < 0.1:
            repair_too, copy = self.repair, self.path.with_name("copy")
            shutil.copytree(self.path, copy, symlinks=True, copy_function=copy_or_make)
            outcome = verdict(lambda: repair_too(copy))
            result = f"{result} (repair: {outcome})" if not outcome.startswith("failed") else outcome
            shutil.rmtree(copy)
        restore(self.sound, self.path, file.relative_to(self.path))
        return result


def damage(path: Path, file: Path, rng: np.random.Generator) -> None:
    """Change one file, and mostly make the others vouch for it."""
    if rng.random() < 0.03:
        replace_by_no_file(file, rng)
        return
    file.write_bytes(mutant_of(file, file.read_bytes(), rng))
    if rng.random() < 0.9:
        vouch(path, file)


def copy_or_make(source: str, target: str) -> None:
    """Copy a file; of a pipe, nothing."""
    if Path(source).is_file():
        shutil.copy2(source, target)


def restore(sound: Path, path: Path, file: Path) -> None:
    """Put back what a mutant changed: a file, and those beside and above it that vouch for it."""
    for name in (file, *(folder / name for folder in file.parents for name in SEALS)):
        if (sound / name).is_file():
            remove(path / name)
            shutil.copy2(sound / name, path / name)


def limit_memory() -> None:
    """Let this process take no more than so much beyond what it has."""
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    limit = pages * resource.getpagesize() + MEMORY
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))


def verdict(read: Callable[[], list[str]]) -> str:
    """What came of a mutant: "refused: ...", "survived", or "failed: ..."."""
    try:
        lines = read()
    except AdaAffordError as error:
        lines = [str(error)]
    except BaseException as error:  # noqa: BLE001 - whatever else is raised is what we look for.
        last = traceback.extract_tb(error.__traceback__)[-1]
        return f"failed: {type(error).__name__} at {last}: {' '.join(str(error).split())[:200]}"
    for line in lines:
        if "\n" in line or len(line) > LONGEST_MESSAGE:
            return f"failed: {line[:600]!r} is no line for a user"
    return f"refused: {' '.join(lines[0].split())[:200]}" if lines else "survived"


def each(*reads: Callable[[], object]) -> list[str]:
    """Messages of those that refuse."""
    lines = []
    for read in reads:
        try:
            read()
        except AdaAffordError as error:
            lines.append(str(error))
    return lines


def make_store(path: Path) -> None:
    """Two shards and a policy."""
    setting = fabricate_setting()
    plan = Plan(setting=setting, proposer="aip", policy_version=1)
    store = Store.create(path, setting)
    for start in (0, 2):
        job = Job(plan.key, start, start + 2)
        store.commit(plan, job, fabricate_rollouts(plan, job), {})
    store.publish_policy(1, Policy.untrained("push", NETWORK, 1).to_files())


def read_store(path: Path) -> list[str]:
    """Messages of everything that reads a store."""
    store = Store.open(path)
    lines = [problem.what for problem in verify(store)]
    shards = [folder.name for folder in (path / "shards").iterdir() if folder.name[0] != "."]
    return lines + each(
        store.digest,
        lambda: info(store),
        lambda: load_dataset(store, NETWORK),
        lambda: [store.read_rollouts(shard) for shard in sorted(shards)],
        store.rollouts,
        store.interactions,
        lambda: snapshot_of(str(path)),
        lambda: load_policy(path / "policies" / "000001"),
    )


def repair_store(path: Path) -> list[str]:
    """Messages of what is left after a repair."""
    repair(path)
    left = verify(Store.open(path))
    assert not left, left
    return []


def make_policy(path: Path) -> None:
    """A policy as the learner leaves it."""
    path.mkdir(parents=True)
    for name, data in Policy.untrained("push", NETWORK, 1).to_files().items():
        (path / name).write_bytes(data)
    (path / "done.json").write_text('{"objects": ["a", "b"]}')


def read_policy(path: Path) -> list[str]:
    """Messages of everything that reads a policy."""
    return each(lambda: load_policy(path), lambda: objects_seen(path))


def _trainer() -> tuple[nn.Module, torch.optim.Adam]:
    module = nn.Linear(3, 2)
    return module, torch.optim.Adam(module.parameters())


def make_run(path: Path) -> None:
    """What a campaign and a learner leave, apart from a store."""
    path.mkdir(parents=True)
    setting = fabricate_setting()
    objects = [ref.model_dump_json() for ref in setting.objects]
    texts = {
        "config.json": '{"config": ' + CampaignConfig().model_dump_json() + ', "software": {"python": "3.11"}}',
        "objects.json": '{"folder": "x", "train": ['
        + objects[0]
        + '], "validation": [], "test": ['
        + objects[1]
        + "], "
        '"refused": [["a", "b"]]}',
        "log.jsonl": '{"time": 1.0, "event": "began", "stage": "objects"}\n{"time": 1.5, "event": "done", '
        '"stage": "objects", "seconds": 0.5, "result": {"train": 1}}\n',
        "training/aap-1/metrics.jsonl": '{"stage": "aap", "step": 1, "score": 0.5}\n',
        "alternation.json": '{"rounds": [{"round": 1, "score": 0.5}], "best": 1, "converged": true}',
        "aip-1/done.json": '{"stage": "aip", "fingerprint": "a", "metrics": {"score": 0.5}, "objects": ["a"]}',
        "published.json": '{"round-1": 1}',
        "data-1.json": '{"ranges": {"random-v0": [[0, 8], [16, 24]]}}',
        "objects.txt": "45166 Faucet\n45167 Faucet\n",
        "settings.toml": 'task = "push"\nseed = 3\n[collection.camera]\npoints = 256\n',
    }
    for name, text in texts.items():
        (path / name).parent.mkdir(parents=True, exist_ok=True)
        (path / name).write_text(text)
    module, optimiser = _trainer()
    module(torch.ones(1, 3)).sum().backward()
    optimiser.step()
    write_checkpoint(path / "checkpoint.safetensors", Cursor(step=3), module, module.state_dict(), optimiser)


def read_run(path: Path) -> list[str]:
    """Messages of everything that reads a run's files."""
    module, optimiser = _trainer()
    return each(
        lambda: find(path),
        RunFolder(path).objects_used,
        lambda: RunLog(path / "log.jsonl"),
        lambda: snapshot_of(str(path)),
        lambda: trained_in(path),
        lambda: best_score(path / "aip-1"),
        lambda: objects_seen(path / "aip-1"),
        lambda: _published(path),
        lambda: _read_snapshot(path / "data-1.json"),
        lambda: read_object_list(path / "objects.txt"),
        lambda: parse(CampaignConfig, load_toml(path / "settings.toml"), "settings.toml"),
        lambda: read_cursor(path / "checkpoint.safetensors"),
        lambda: read_checkpoint(path / "checkpoint.safetensors", module, optimiser),
    )


if __name__ == "__main__":
    main()
