"""`adaafford objects`: generate, import, export, check, draw, decompose and scan objects."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro
from pydantic import Field

from cluster.config.flags import Action, OutFolder, dispatch
from shared.config import PANDA
from shared.errors import UsageError
from shared.formatting import counted
from shared.io.text import plain

Direction = Literal["+x", "-x", "+y", "-y", "+z", "-z"]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]

if TYPE_CHECKING:
    from collector.objects.catalogue import CatalogueEntry


@dataclass(frozen=True, slots=True)
class GenerateCommand:
    """Make built-in procedural objects in PartNet-Mobility's layout."""

    out: Annotated[OutFolder, tyro.conf.Positional]
    """Folder of the objects; existing ones are kept."""
    per_category: Annotated[int, Field(ge=1)] = 4
    """Objects of each category."""
    categories: tuple[str, ...] = ()
    """Only these; "train" and "test" stand for the paper's ten and five. Default: all."""
    seed: int = 1
    """Everything random derives from it."""


@dataclass(frozen=True, slots=True)
class ImportCommand:
    """Turn an object of another layout (URDF, MJCF, GAPartNet, Articulate-Anything) into one of ours, and check it."""

    source: Annotated[Path, tyro.conf.Positional]
    """A .urdf or MJCF .xml file, or an object's folder."""
    out: OutFolder
    """Folder of objects; the object becomes a folder in it, and ID.png beside it shows it before and after."""
    id: str | None = None
    """What the object is called; the name of its file or folder unless given."""
    category: str | None = None
    """Such as Microwave, which tasks ask for; what the source says unless given."""
    part_names: tuple[str, ...] = ()
    """Names that tasks ask for, by link or body: `LINK=door`."""
    front: Direction | None = None
    """Direction, in the file, that the object's front faces; that of the layout unless given: +x of
    Articulate-Anything, -x of others."""
    up: Direction = "+z"
    """Direction, in the file, that is up."""
    scale: Positive | None = None
    """Multiply all lengths by this instead of giving the object a size."""
    size: Positive | None = None
    """Diagonal of the object's bounding box afterwards; 2, as that of published objects, unless given."""
    search_path: tuple[Path, ...] = ()
    """Folders, beside that of the file, where meshes and included files may be."""
    root: str | None = None
    """The link or body from which on the object is wanted, where the file holds a robot or a room as well."""
    radians: tyro.conf.FlagCreatePairsOff[bool] = False
    """Angles of an MJCF that does not say their unit are radians; MuJoCo takes them for degrees."""
    replace: tyro.conf.FlagCreatePairsOff[bool] = False
    """Replace an object of this name that was imported before."""


@dataclass(frozen=True, slots=True)
class ExportCommand:
    """Write objects as URDF or MJCF, with the convex pieces that are simulated, for other programs to read."""

    path: Annotated[Path, tyro.conf.Positional]
    """One object's folder, or a folder of objects."""
    out: OutFolder
    """Folder; each object becomes a folder in it."""
    format: Literal["urdf", "mjcf"] = "urdf"
    """Of the main file, which is called mobility.urdf or object.xml."""
    collision: Literal["hulls", "decomposed"] = "hulls"
    """As of a collection: one convex hull a mesh, or several pieces that keep cavities open."""
    part_mass: Positive = 0.16
    """kg, of each movable part; a collection draws it anew for each rollout, from 0.05 to 0.5 unless told otherwise."""


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


@dataclass(frozen=True, slots=True)
class ScenesCommand:
    """Make labelled scans of objects among other things, with the errors of a depth camera, for `train segmentation`.

    The same command goes on where it was stopped.
    """

    path: Annotated[Path, tyro.conf.Positional]
    """A folder of objects."""
    out: Annotated[OutFolder, tyro.conf.Positional]
    """Folder of the scenes: new, or of the same settings."""
    count: Annotated[int, Field(ge=1, le=100_000)] = 1500
    """Number of scenes; each object in turn, in a random order."""
    noise: tuple[Annotated[float, Field(ge=0, le=10)], Annotated[float, Field(ge=0, le=10)]] = (0.3, 1.5)
    """Least and greatest strength of the errors: 0 is none, 1 a structured-light camera one metre from the object."""
    seed: Annotated[int, Field(ge=0)] = 1
    """Everything random derives from it."""


def _generate(command: GenerateCommand) -> int:
    from collector.objects.procedural.catalogue import CATEGORIES, generate
    from shared.tasks import expanded

    counts = dict.fromkeys(expanded(command.categories) or CATEGORIES, command.per_category)
    made = generate(command.out, counts, command.seed)
    print(f"{counted(len(made), 'object')} of {counted(len(counts), 'category', 'categories')} in {command.out}")
    return 0


def _import(command: ImportCommand) -> int:
    from collector.objects.catalogue import OBJECT_ID
    from collector.objects.importing.importer import ImportSettings, import_object
    from collector.objects.importing.layouts import USUAL_SIZE, Placement, source_of
    from collector.viz.rendering import contact_sheet
    from shared.errors import ObjectError
    from shared.extras import require

    require("the picture of an import", "report", without=("plotly", "jinja2"))
    if command.scale is not None and command.size is not None:
        raise UsageError("--scale and --size exclude each other; give one of them")
    source = source_of(command.source)
    placement = Placement(
        command.front or source.front, command.up, command.scale, USUAL_SIZE if command.size is None else command.size
    )
    names = dict(_assigned(word) for given in command.part_names for word in given.split(",") if word)
    settings = ImportSettings(
        command.search_path, placement, command.category, names, command.root, command.radians, command.replace
    )
    name = command.id or source.name
    if not OBJECT_ID.fullmatch(name):
        raise UsageError(
            f"'{plain(name, 80)}' cannot be an object's id; give one by --id, which may hold letters, digits, '.', '_' "
            "and '-', up to 100"
        )
    folder = command.out / name
    try:
        made = import_object(source, folder, settings)
    except ObjectError as error:
        print(plain(f"{folder.name}  refused: {error}"))
        return UsageError.exit_code
    sheet = command.out / f"{folder.name}.png"
    extent = " x ".join(f"{edge:.3g}" for edge in made.extent)
    before = f"before, {extent}"
    after = f"after, front {placement.front}, up {placement.up}"
    contact_sheet([made.before, made.after], sheet, titles=[before, after])
    movable = counted(len(made.after.parts), "movable part")
    print(plain("; ".join([f"{folder.name}  usable: {made.after.ref.category}, {movable}", *made.notes])))
    for body in made.after.parts:
        assert body.joint is not None
        print(plain(f"  {body.part_name}: {body.joint.kind}, {body.joint.lower:.4g} to {body.joint.upper:.4g}"))
    print(plain(f"{sheet}: as in the file ({extent}), and as it stands now; its front should face the camera"))
    return 0


def _assigned(word: str) -> tuple[str, str]:
    link, sign, name = word.rpartition("=")
    if not sign or not link or not name:
        raise UsageError(f"--part-names takes LINK=NAME, such as link_1=door; given {word[:80]!r}")
    return link, name


def _export(command: ExportCommand) -> int:
    from collector.objects.catalogue import load_ref, scan
    from collector.objects.exporting import export_object
    from shared.errors import ObjectError

    catalogue = scan(command.path)
    usable, failed = catalogue.usable, len(catalogue.refused)
    for object_id, reason in catalogue.refused:
        print(plain(f"{object_id}  refused: {reason}"))
    for entry in usable:
        try:
            target = load_ref(command.path, entry.ref, command.collision)
            main = export_object(target, command.format, command.out / entry.ref.id, command.part_mass)
        except ObjectError as error:
            failed += 1
            print(plain(f"{entry.ref.id}  refused: {error}"))
        else:
            print(plain(f"{entry.ref.id}  {main}"))
    exported = len(usable) + len(catalogue.refused) - failed
    print(f"{exported} exported, {failed} refused")
    return 0 if exported else UsageError.exit_code


def _check(command: CheckCommand) -> int:
    from collector.objects.catalogue import for_task, of_categories, scan
    from shared.tasks import expanded, task_of

    lists = () if command.object_list is None else (command.object_list,)
    catalogue = of_categories(scan(command.path, *lists, anew=True), expanded(command.categories))
    if command.task is not None:
        catalogue = for_task(catalogue, task_of(command.task))
    described = {object_id: f"refused: {reason}" for object_id, reason in catalogue.refused}
    described |= dict.fromkeys((entry.ref.id for entry in catalogue.usable), "")
    entries, restless = {entry.ref.id: entry for entry in catalogue.usable}, 0
    for object_id in sorted(described):
        line = described[object_id]
        if object_id in entries:
            entry = entries[object_id]
            line = "; ".join([f"usable: {entry.ref.category}, {counted(entry.movable, 'movable part')}", *entry.notes])
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


def _check_png(out: Path) -> None:
    if out.suffix.lower() != ".png":
        raise UsageError(f"{out}: not a kind of picture that is written; allowed: .png")


def _preview(command: PreviewCommand) -> int:
    from collector.objects.catalogue import load, scan
    from collector.viz.rendering import contact_sheet

    _check_png(command.out)
    usable = scan(command.path).usable
    shown = usable[: command.most]
    contact_sheet([load(entry) for entry in shown], command.out)
    print(f"{command.out}: {len(shown)} of {len(usable)} usable objects")
    return 0


def _film(command: FilmCommand) -> int:
    from collector.objects.catalogue import load, scan
    from collector.viz.film import film
    from shared.primitives import PRIMITIVES

    _check_png(command.out)
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


def _scenes(command: ScenesCommand) -> int:
    from collector.scenes import make_scenes
    from shared.extras import require
    from shared.progress import Progress

    require("adaafford objects scenes", "collect", without=("ray",))
    if command.noise[0] > command.noise[1]:
        raise UsageError(f"--noise {command.noise[0]:g} {command.noise[1]:g}: needs the least strength first")
    with Progress("scenes", command.count) as progress:
        made = make_scenes(command.path, command.out, command.count, command.seed, command.noise, progress.show)
    print(plain(f"{command.out}: {made.count} scenes of {len(made.objects)} objects"))
    return 0


ACTIONS: dict[str, Action] = {
    "generate": (GenerateCommand, _generate),
    "import": (ImportCommand, _import),
    "export": (ExportCommand, _export),
    "check": (CheckCommand, _check),
    "preview": (PreviewCommand, _preview),
    "film": (FilmCommand, _film),
    "decompose": (DecomposeCommand, _decompose),
    "scenes": (ScenesCommand, _scenes),
}


def main(args: list[str]) -> int:
    """Run one of the actions."""
    return dispatch("objects", ACTIONS, args, "PATH")
