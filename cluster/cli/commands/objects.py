"""`adaafford objects`: generate, check, draw and decompose objects."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro
from pydantic import Field

from cluster.config.flags import Action, dispatch
from shared.config import PANDA
from shared.errors import UsageError
from shared.io.text import plain

if TYPE_CHECKING:
    from collector.objects.catalogue import CatalogueEntry


@dataclass(frozen=True, slots=True)
class GenerateCommand:
    """Make built-in procedural objects in PartNet-Mobility's layout."""

    out: Annotated[Path, tyro.conf.Positional]
    """Folder of the objects; existing ones are kept."""
    per_category: Annotated[int, Field(ge=1)] = 4
    """Objects of each category."""
    categories: tuple[str, ...] = ()
    """Only these; "train" and "test" stand for the paper's ten and five. Default: all."""
    seed: int = 1
    """Everything random derives from it."""


@dataclass(frozen=True, slots=True)
class CheckCommand:
    """Print one line for each object: usable, or the reason why not; the exit code is 2 if none is usable."""

    path: Annotated[Path, tyro.conf.Positional]
    """A folder of objects, or one object's folder."""
    task: str | None = None
    """Also check which objects suit this task: a name, or a TOML file."""
    object_list: Path | None = None
    """Only the objects of this list, `<id> <category>` a line, such as Where2Act publishes."""
    categories: tuple[str, ...] = ()
    """Only objects of these; "train" and "test" stand for the paper's ten and five."""
    settle: tyro.conf.FlagCreatePairsOff[bool] = False
    """Also simulate whether usable objects come to rest, as at the start of a rollout; about a second each."""


@dataclass(frozen=True, slots=True)
class PreviewCommand:
    """Draw a contact sheet: the body grey, every movable part in another colour."""

    path: Annotated[Path, tyro.conf.Positional]
    """A folder of objects, or one object's folder."""
    out: Annotated[Path, tyro.conf.Positional]
    """The picture, a PNG."""
    most: int = 100
    """The most objects to draw."""


@dataclass(frozen=True, slots=True)
class FilmCommand:
    """Draw one object's trials: each primitive at its start, at first contact and at its end."""

    path: Annotated[Path, tyro.conf.Positional]
    """One object's folder, or a folder of objects, whose first usable one is taken."""
    out: Annotated[Path, tyro.conf.Positional]
    """The picture, a PNG."""
    primitives: tuple[str, ...] = ()
    """Only these primitives; default: all."""
    gripper: str = PANDA
    """The hand."""
    seed: int = 1
    """Of the random trials, one of which is shown of each primitive."""


@dataclass(frozen=True, slots=True)
class DecomposeCommand:
    """Decompose collision meshes into convex pieces, once and for all, for `--collection.collision decomposed`."""

    path: Annotated[Path, tyro.conf.Positional]
    """A folder of objects, or one object's folder."""


def _generate(command: GenerateCommand) -> int:
    from collector.objects.procedural.catalogue import CATEGORIES
    from collector.objects.procedural.writing import generate
    from shared.categories import expanded

    counts = dict.fromkeys(expanded(command.categories) or CATEGORIES, command.per_category)
    made = generate(command.out, counts, command.seed)
    print(f"{len(made)} objects of {len(counts)} categories in {command.out}")
    return 0


def _check(command: CheckCommand) -> int:
    from collector.objects.catalogue import for_task, of_categories, scan
    from shared.categories import expanded
    from shared.tasks import task_of

    lists = () if command.object_list is None else (command.object_list,)
    catalogue = of_categories(scan(command.path, *lists), expanded(command.categories))
    if command.task is not None:
        catalogue = for_task(catalogue, task_of(command.task))
    described = {object_id: f"refused: {reason}" for object_id, reason in catalogue.refused}
    described |= dict.fromkeys((entry.ref.id for entry in catalogue.usable), "")
    entries, restless = {entry.ref.id: entry for entry in catalogue.usable}, 0
    for object_id in sorted(described):
        line = described[object_id]
        if object_id in entries:
            entry = entries[object_id]
            line = "; ".join([f"usable: {entry.ref.category}, {_parts(entry.movable)}", *entry.notes])
            if command.settle:
                rests, draws = _draws_at_rest(entry, command.task)
                line += f"; comes to rest in {rests or 'none'} of {draws} draws"
                restless += not rests
        print(plain(f"{object_id}  {line}"), flush=True)
    said = f", {restless} of these never at rest, so that nothing can be collected of them" if restless else ""
    print(f"{len(catalogue.usable)} usable{said}, {len(catalogue.refused)} refused")
    return 0 if len(catalogue.usable) > restless else UsageError.exit_code


def _draws_at_rest(entry: "CatalogueEntry", task: str | None) -> tuple[int, int]:
    """How many of the draws of a rollout come to rest, and how many there are."""
    from collector.objects.catalogue import load
    from collector.rollout import TRIES, draws_at_rest
    from collector.setting import make_setting
    from shared.config import CollectionConfig
    from shared.plan import Plan
    from shared.tasks import task_of

    setting = make_setting(task_of(task or "push"), CollectionConfig(), seed=1, objects=(entry.ref,))
    return draws_at_rest(Plan(setting=setting), 0, load(entry)), TRIES


def _preview(command: PreviewCommand) -> int:
    from collector.objects.catalogue import load, scan
    from collector.viz.preview import contact_sheet

    usable = scan(command.path).usable
    shown = usable[: command.most]
    contact_sheet([load(entry) for entry in shown], command.out)
    print(f"{command.out}: {len(shown)} of {len(usable)} usable objects")
    return 0


def _film(command: FilmCommand) -> int:
    from collector.objects.catalogue import load, scan
    from collector.viz.film import film
    from shared.primitives import PRIMITIVES

    usable = scan(command.path).usable
    if not usable:
        raise UsageError(f"{command.path}: a film needs a usable object; try `adaafford objects check`")
    primitives = [name for given in command.primitives for name in given.split(",") if name] or PRIMITIVES.names()
    for caption in film(load(usable[0]), primitives, command.seed, command.out, command.gripper):
        print(caption)
    print(plain(f"{command.out}: {usable[0].ref.id}, {usable[0].ref.category}"))
    return 0


def _decompose(command: DecomposeCommand) -> int:
    from collector.objects.catalogue import load, scan
    from collector.objects.decomposition import Decomposer
    from shared.errors import ObjectError
    from shared.io.private import cache_folder
    from shared.progress import Progress

    usable, failed = scan(command.path).usable, 0
    with Decomposer(cache_folder("pieces")) as decomposer:
        for number, entry in enumerate(usable, start=1):
            try:
                target = load(entry)
                with Progress(f"{entry.ref.id} ({number} of {len(usable)}), meshes") as progress:
                    opened = decomposer.decomposed(target, progress.show)
            except ObjectError as error:
                failed += 1
                print(plain(f"{entry.ref.id}  refused: {error}"))
            else:
                meshes, pieces = (sum(len(body.collisions) for body in o.bodies) for o in (target, opened))
                print(plain(f"{entry.ref.id}  {meshes} meshes, {pieces} convex pieces"))
    print(f"{len(usable) - failed} decomposed into {cache_folder('pieces')}, {failed} refused")
    return 0 if failed < len(usable) else UsageError.exit_code


def _parts(count: int) -> str:
    return f"{count} movable part{'' if count == 1 else 's'}"


ACTIONS: dict[str, Action] = {
    "generate": (GenerateCommand, _generate),
    "check": (CheckCommand, _check),
    "preview": (PreviewCommand, _preview),
    "film": (FilmCommand, _film),
    "decompose": (DecomposeCommand, _decompose),
}


def main(args: list[str]) -> int:
    """Run one of the actions."""
    return dispatch("objects", ACTIONS, args, "PATH")
