"""The folder of a run: what lies where, which configuration it belongs to, and what made it.

RUN/
  config.json            resolved configuration, git commit, package versions; written once
  objects.json           which objects were split how, and which were refused and why
  objects/               procedural objects, if no folder of objects was given
  store/                 the interactions, and the published policies
  evaluation/            a second store: what was tried on unseen objects
  training/<stage>/      checkpoints, metrics and output of each training stage
  log.jsonl              the ledger: stages, times, results
  summary.json           figures
  affordance.png         one object before and after each try
  report.html            all of it to look at, in one file
"""

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cluster.configuration import EXECUTION_SETTINGS, CampaignConfig
from cluster.settings import difference
from shared.configuration import StrictModel, parse
from shared.documents import parse_object
from shared.errors import UsageError
from shared.files import create_exclusively, read_bounded
from shared.plan import ObjectRef
from shared.store.provenance import software_versions

MAX_DOCUMENT_BYTES = 64 << 20


class ObjectsUsed(StrictModel):
    """objects.json: the objects of a run."""

    folder: str
    train: tuple[ObjectRef, ...]
    validation: tuple[ObjectRef, ...]
    test: tuple[ObjectRef, ...]
    refused: tuple[tuple[str, str], ...]
    """(id, reason)."""


@dataclass(frozen=True, slots=True)
class RunFolder:
    """Paths within a run."""

    path: Path

    @property
    def config(self) -> Path:
        """config.json."""
        return self.path / "config.json"

    @property
    def objects_file(self) -> Path:
        """objects.json."""
        return self.path / "objects.json"

    @property
    def generated_objects(self) -> Path:
        """Procedural objects."""
        return self.path / "objects"

    @property
    def store(self) -> Path:
        """The interactions."""
        return self.path / "store"

    @property
    def evaluation(self) -> Path:
        """The evaluation's interactions."""
        return self.path / "evaluation"

    @property
    def log(self) -> Path:
        """The ledger."""
        return self.path / "log.jsonl"

    @property
    def summary(self) -> Path:
        """summary.json."""
        return self.path / "summary.json"

    @property
    def picture(self) -> Path:
        """affordance.png."""
        return self.path / "affordance.png"

    @property
    def oracle(self) -> Path:
        """The training stage that may have left an oracle."""
        return self.adopted if self.adopted.is_dir() else self.training("aap-1")

    @property
    def adopted(self) -> Path:
        """The policy that the run went on from, if it did (`cluster.adoption`)."""
        return self.training("adopted")

    @property
    def page(self) -> Path:
        """report.html."""
        return self.path / "report.html"

    def are_novel(self, tested: Iterable[ObjectRef]) -> bool:
        """Whether objects are of categories that nothing was trained on; of an adopted policy nobody knows."""
        used = self.objects_used()
        learned_from = (ref.category for ref in (*used.train, *used.validation))
        return not self.adopted.is_dir() and {ref.category for ref in tested}.isdisjoint(learned_from)

    def training(self, stage: str) -> Path:
        """What a training stage leaves."""
        return self.trainings / stage

    @property
    def trainings(self) -> Path:
        """What all training stages leave."""
        return self.path / "training"

    @property
    def evaluations(self) -> Path:
        """What `adaafford evaluate` leaves, a folder each."""
        return self.path / "evaluations"

    def objects_used(self) -> ObjectsUsed:
        """What objects.json says."""
        return parse(ObjectsUsed, read_json(self.objects_file), str(self.objects_file))


def begin(path: Path, config: CampaignConfig) -> RunFolder:
    """Make the folder of a new run, or find the one that was begun with the same configuration.

    Raises:
        UsageError: the folder holds another run, or anything else.
    """
    run = RunFolder(path)
    document = {"config": config.model_dump(mode="json"), "software": software_versions()}
    if path.exists() and not path.is_dir():
        raise UsageError(f"{path}: not a folder; name a new one")
    if not run.config.exists() and path.exists() and any(_foreign(path)):
        raise UsageError(f"{path}: holds something that is no run; name a new or an empty folder")
    path.mkdir(parents=True, exist_ok=True)
    if create_exclusively(run.config, json.dumps(document, indent=2).encode()):
        return run
    before, now = (_decisive(each) for each in (_read_config(run), document["config"]))
    changed = difference(before, now)
    if changed is not None:
        raise UsageError(f"{path}: holds another run ({changed}); name a new folder, or `adaafford resume {path}`")
    return run


def find(path: Path) -> tuple[RunFolder, CampaignConfig]:
    """The run in `path`, and its configuration.

    Raises:
        UsageError: there is none.
    """
    run = RunFolder(path)
    if not run.config.is_file():
        raise UsageError(f"{path}: holds no run (no config.json); start one with `adaafford run --out {path}`")
    return run, parse(CampaignConfig, _read_config(run), str(run.config))


def _foreign(path: Path) -> list[Path]:
    """What lies in a folder apart from hidden files, which a killed attempt may have left."""
    return [child for child in path.iterdir() if not child.name.startswith(".")]


def _decisive(config: Mapping[str, Any]) -> dict[str, Any]:
    """The settings that decide what a run produces; how many workers do it is not one of them."""
    return {name: value for name, value in config.items() if name not in EXECUTION_SETTINGS}


def _read_config(run: RunFolder) -> dict[str, Any]:
    config = read_json(run.config).get("config")
    if not isinstance(config, dict):
        raise UsageError(f"{run.config}: not the configuration of a run; name another folder")
    return config


def read_json(path: Path) -> dict[str, Any]:
    """A JSON object of the run.

    Raises:
        StoreError: the file is missing, too large or damaged.
    """
    return parse_object(read_bounded(path, MAX_DOCUMENT_BYTES), str(path), unique=True)
