"""The folder of a run: its files, its configuration, and the software that made it.

RUN/
  config.json            resolved configuration, git commit, package versions; written once
  places.json            paths of files outside the run on this machine; leave it out when you publish the run
  objects.json           the split of the objects, and refused objects with reasons
  objects/               procedural objects, if no folder of objects was given
  store/                 the interactions, and the published policies
  evaluation/            a second store: the interactions with unseen objects
  training/<stage>/      checkpoints, metrics and output of each training stage
  log.jsonl              the run log: stages, times, results
  summary.json           results
  affordance.png         one object before and after each interaction
  report.html            all results on one page

The folder may be renamed, moved or copied, because it contains no absolute paths. Objects outside it are identified by
their content, so they may move, too (`adaafford resume RUN --objects FOLDER`).
"""

import json
import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cluster.config.campaign_config import EXECUTION_SETTINGS, CampaignConfig
from shared.config import StrictModel, parse
from shared.errors import UsageError
from shared.io.documents import differences, parse_object
from shared.io.files import create_exclusively, make_folder, read_bounded, write_atomically
from shared.plan import ObjectRef
from shared.software import software_versions

MAX_DOCUMENT_BYTES = 64 << 20
PLACE_SETTINGS = ("objects", "object_list", "start_from", "splits.train_list", "splits.test_list", "ray_address")
"""Settings that are paths; config.json has only their last parts, and places.json has the whole paths."""


class ObjectsUsed(StrictModel):
    """objects.json: the objects of a run."""

    folder: str
    """Name of the folder; `RunFolder.objects_folder` gives its path."""
    train: tuple[ObjectRef, ...]
    validation: tuple[ObjectRef, ...]
    test: tuple[ObjectRef, ...]
    refused: tuple[tuple[str, str], ...]
    """(id, reason)."""

    @property
    def all(self) -> tuple[ObjectRef, ...]:
        """The objects of all three sets."""
        return (*self.train, *self.validation, *self.test)


class _Within:
    """The path of something in a run's folder."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __get__(self, run: "RunFolder", _: object = None) -> Path:
        return run.path / self._name


@dataclass(frozen=True, slots=True)
class RunFolder:
    """Paths within a run, as the list above describes them."""

    path: Path

    config = _Within("config.json")
    places = _Within("places.json")
    objects_file = _Within("objects.json")
    generated_objects = _Within("objects")
    store = _Within("store")
    evaluation = _Within("evaluation")
    evaluations = _Within("evaluations")
    """What `adaafford evaluate` makes, a folder each."""
    trainings = _Within("training")
    adopted = _Within("training/adopted")
    """The policy that the run started from, if there is one (`cluster.runs.warm_start`)."""
    log = _Within("log.jsonl")
    summary = _Within("summary.json")
    picture = _Within("affordance.png")
    page = _Within("report.html")

    @property
    def oracle(self) -> Path:
        """The training stage that may have left an oracle."""
        return self.adopted if self.adopted.is_dir() else self.training("aap-1")

    def are_novel(self, tested: Iterable[ObjectRef]) -> bool:
        """Whether the objects have only categories that were not trained on; unknown for an adopted policy."""
        used = self.objects_used()
        learned_from = (ref.category for ref in (*used.train, *used.validation))
        return not self.adopted.is_dir() and {ref.category for ref in tested}.isdisjoint(learned_from)

    def training(self, stage: str) -> Path:
        """The folder of a training stage."""
        return self.trainings / stage

    def objects_folder(self) -> Path:
        """The folder of the run's objects: in the run, or the last one that the user gave.

        Raises:
            UsageError: it does not exist any more.
        """
        named = _read_config(self).get("objects")
        folder = self.generated_objects.resolve() if named is None else Path(str(named))
        if not self.objects_file.is_file() or folder.is_dir():
            return folder
        if named is None:
            raise UsageError(f"{folder}: the run's own objects are not there any more; restore the folder from a copy")
        raise UsageError(
            f"{folder}: the objects of {self.path} are not there any more; say where they are with "
            f"`adaafford resume {self.path} --objects FOLDER`"
        )

    def generates_objects(self) -> bool:
        """Whether its objects are procedural."""
        return _read_config(self).get("objects") is None

    def begun_with(self) -> dict[str, str]:
        """Software versions at the start of the run."""
        known = read_json(self.config).get("software")
        return {str(name): str(version) for name, version in known.items()} if isinstance(known, dict) else {}

    def objects_used(self) -> ObjectsUsed:
        """The contents of objects.json."""
        return parse(ObjectsUsed, read_json(self.objects_file), str(self.objects_file))


def begin(path: Path, config: CampaignConfig) -> RunFolder:
    """Create the folder of a new run, or open a run with the same configuration.

    Raises:
        UsageError: the folder has another run or other files.
    """
    run = RunFolder(path)
    settings = config.model_dump(mode="json")
    document = {"config": _without_places(settings), "software": software_versions()}
    if path.exists() and not path.is_dir():
        raise UsageError(f"{path}: not a folder; name a new one")
    if not run.config.exists() and path.exists() and any(_foreign(path)):
        raise UsageError(f"{path}: holds something that is not a run; name a new or an empty folder")
    make_folder(path)
    if not run.config.exists():
        # First, since with config.json a run has begun.
        _write_places(run, settings)
    if create_exclusively(run.config, json.dumps(document, indent=2).encode()):
        return run
    before, now = (_decisive(each) for each in (_read_config(run), settings))
    if (changed := next(differences(before, now), None)) is not None:
        name, was, given = changed
        moved = f" --objects {config.objects}" if name == "objects" and config.objects else ""
        raise UsageError(
            f"{path}: holds another run ('{name}' was {was}, is now {given}); name a new folder, or "
            f"`adaafford resume {path}{moved}`"
        )
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


def note_places(run: RunFolder, config: CampaignConfig) -> None:
    """Record the new path of something that the run needs."""
    _write_places(run, config.model_dump(mode="json"))


def _write_places(run: RunFolder, settings: Mapping[str, Any]) -> None:
    found = {name: _setting(settings, name) for name in PLACE_SETTINGS}
    places = {name: place for name, place in found.items() if place is not None}
    if places:
        write_atomically(run.places, json.dumps(places, indent=1).encode())
    else:
        run.places.unlink(missing_ok=True)


def _without_places(settings: dict[str, Any]) -> dict[str, Any]:
    names = {name: _setting(settings, name) for name in PLACE_SETTINGS}
    # With a dot before it, a path's last part is not taken for one of the names that the package brings.
    short = {
        name: f"./{Path(place).name}" if os.sep in place else place
        for name, place in names.items()
        if place is not None
    }
    return _with_settings(settings, short | {"ray_address": None})


def _setting(settings: Mapping[str, Any], name: str) -> str | None:
    found: Any = settings
    for part in name.split("."):
        found = found.get(part) if isinstance(found, Mapping) else None
    return None if found is None else str(found)


def _with_settings(settings: Mapping[str, Any], values: Mapping[str, str | None]) -> dict[str, Any]:
    """Settings with some of them replaced, each by its name with dots."""
    told = dict(settings)
    for name, value in values.items():
        table, _, key = name.rpartition(".")
        if table:
            told[table] = {**(told.get(table) or {}), key: value}
        else:
            told[key] = value
    return told


def _foreign(path: Path) -> list[Path]:
    """The files in a folder, without hidden files and places.json, which a killed attempt may have left."""
    own = RunFolder(path).places
    return [child for child in path.iterdir() if not child.name.startswith(".") and child != own]


def _decisive(config: Mapping[str, Any]) -> dict[str, Any]:
    """The settings that decide what a run produces; how many workers do it is not one of them."""
    return {name: value for name, value in config.items() if name not in EXECUTION_SETTINGS}


def _read_config(run: RunFolder) -> dict[str, Any]:
    config = read_json(run.config).get("config")
    if not isinstance(config, dict):
        raise UsageError(f"{run.config}: not the configuration of a run; name another folder")
    # Runs of older software have whole paths in config.json; of a run that was published the places are unknown.
    places = read_json(run.places) if run.places.is_file() else {}
    return _with_settings(config, {name: str(place) for name, place in places.items() if name in PLACE_SETTINGS})


def read_json(path: Path) -> dict[str, Any]:
    """A JSON object of the run.

    Raises:
        StoreError: the file is missing, too large or damaged.
    """
    return parse_object(read_bounded(path, MAX_DOCUMENT_BYTES), str(path), unique=True)
