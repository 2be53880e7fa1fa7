"""Settings from defaults, a preset, a file and flags; later ones replace earlier ones, and every setting has a flag."""

import argparse
import difflib
import os
import re
from collections.abc import Callable, Mapping
from contextlib import redirect_stderr, redirect_stdout, suppress
from dataclasses import fields, is_dataclass, replace
from functools import partial
from io import StringIO
from pathlib import Path
from types import GenericAlias, NoneType
from typing import Annotated, Any, Literal, TypeVar, get_args, get_origin

import tyro
from pydantic import AfterValidator, BaseModel, TypeAdapter, ValidationError
from tyro.constructors import (
    ConstructorRegistry,
    PrimitiveConstructorSpec,
    PrimitiveTypeInfo,
    UnsupportedTypeAnnotationError,
)

from shared.config import CollectionConfig, DynamicsRanges, Name, load_toml, merge, parse
from shared.errors import UsageError
from shared.io.documents import VALUE_ERROR, reason_of

PRESETS_FOLDER = Path(__file__).parent / "presets"

Model = TypeVar("Model", bound=BaseModel)
Command = TypeVar("Command")
Action = tuple[type[Any], Callable[[Any], int]]
"""What declares the flags of an action, and what is run with them; returns the exit code."""


def _can_be_folder(path: Path) -> Path:
    there = next((each for each in (path, *path.parents) if os.path.lexists(each)), None)
    if there is not None and not there.is_dir():
        raise UsageError(f"{path}: no folder can be made of this name ({there} is no folder); name another")
    return path


def _can_be_file(path: Path) -> Path:
    if path.is_dir():
        raise UsageError(f"{path}: is a folder; name a file")
    if not path.parent.is_dir():
        raise UsageError(f"{path}: there is no folder {path.parent}; create it, or name another place")
    return path


OutFolder = Annotated[Path, AfterValidator(_can_be_folder)]
"""A folder that a command writes, which is made where missing; what can be none is refused before anything is done."""
OutFile = Annotated[Path, AfterValidator(_can_be_file)]
"""A file that a command writes into a folder that is there; what can be none is refused, too."""

FLAG_STYLE = (tyro.conf.AvoidSubcommands, tyro.conf.EnumChoicesFromValues)
FLAG_TYPES = ConstructorRegistry()
"""How the values of flags are read where tyro's own way is not ours."""


@FLAG_TYPES.primitive_rule
def _list_with_commas(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | None:
    """Let commas divide numbers and names, as spaces do (`--budgets 1,2,4`); paths may hold commas."""
    kind, *rest = get_args(info.type) or (None,)
    if info.type_origin is not tuple or rest != [Ellipsis]:
        return None
    as_list: Any = GenericAlias(list, (kind,))
    spec = ConstructorRegistry.get_primitive_spec(PrimitiveTypeInfo.make(as_list, info.markers))
    if isinstance(spec, UnsupportedTypeAnnotationError):
        return None
    numbers = PrimitiveTypeInfo.make(kind, info.markers).type is int
    if spec.choices is None and not numbers and kind != Name:
        return None
    choices = spec.choices

    def read(args: list[str]) -> tuple[Any, ...]:
        words = [word for arg in args for word in arg.split(",") if word]
        if wrong := [word for word in words if choices is not None and word not in choices]:
            raise ValueError(f"invalid choice {wrong[0][:80]!r}; allowed: {', '.join(choices or ())}")
        return tuple(spec.instance_from_str(words))

    return replace(spec, instance_from_str=read, is_instance=lambda given: isinstance(given, tuple), choices=None)


@FLAG_TYPES.primitive_rule
def _ranges_by_name(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | None:
    """Let hidden parameters be named with or without a range: `joint_damping,part_mass=0.1:0.5:log`."""
    if DynamicsRanges not in get_args(info.type):
        return None

    def read(args: list[str]) -> DynamicsRanges | None:
        given = {"dynamics": dict(map(_named_range, args[0].split(",")))}
        return parse(CollectionConfig, given, args[0][:80]).dynamics

    return PrimitiveConstructorSpec(
        nargs=1,
        metavar="NAME[=LOW:HIGH[:log]],...",
        instance_from_str=read,
        is_instance=lambda given: given is None or isinstance(given, DynamicsRanges),
        str_from_instance=lambda ranges: ["those of the task" if ranges is None else ", ".join(ranges.root)],
    )


@FLAG_TYPES.primitive_rule
def _choice_or_default(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | None:
    """List the choices of a flag that may be left out in their order, without None."""
    kinds = [kind for kind in get_args(info.type) if kind is not NoneType]
    if NoneType not in get_args(info.type) or len(kinds) != 1 or get_origin(kinds[0]) is not Literal:
        return None
    spec = ConstructorRegistry.get_primitive_spec(PrimitiveTypeInfo.make(kinds[0], info.markers))
    if isinstance(spec, UnsupportedTypeAnnotationError):
        return None
    return replace(
        spec,
        is_instance=lambda given: given is None or spec.is_instance(given),
        str_from_instance=lambda given: ["None"] if given is None else spec.str_from_instance(given),
    )


def _named_range(word: str) -> tuple[str, dict[str, Any]]:
    name, _, interval = word.partition("=")
    match interval.split(":"):
        case [""]:
            return name, {}
        case [low, high, *rest] if rest in ([], ["log"]):
            return name, {"low": float(low), "high": float(high), "log": bool(rest)}
    raise ValueError(f"{word[:80]!r} is no range; write NAME, NAME=LOW:HIGH or NAME=LOW:HIGH:log")


def preset_names() -> list[str]:
    """The names of the presets."""
    return sorted(path.stem for path in PRESETS_FOLDER.glob("*.toml"))


def preset(name: str) -> dict[str, Any]:
    """The settings of a preset.

    Raises:
        UsageError: there is no such preset; the message lists the known ones.
    """
    if name not in preset_names():
        raise UsageError(f"unknown preset '{name}'; allowed: {', '.join(preset_names())}")
    return load_toml(PRESETS_FOLDER / f"{name}.toml")


def layered(model: type[Model], preset_name: str | None, file: Path | None) -> Model:
    """The settings of a model: its defaults, replaced by a preset, replaced by a TOML file; flags are applied later.

    Raises:
        UsageError: the preset or the file is missing, or has a setting that is unknown or not allowed.
    """
    values = preset(preset_name) if preset_name else {}
    if file is None:
        return parse(model, values, f"preset '{preset_name}'")
    over = load_toml(file)
    if "preset" in over:
        raise UsageError(f"{file}: 'preset' is a flag, not a setting; name it on the command line")
    return parse(model, merge(values, over), str(file))


def early_flags(args: list[str], *names: str) -> dict[str, str | None]:
    """The values of a few flags, parsed first because they determine the defaults of the others."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    for name in names:
        parser.add_argument(f"--{name}")
    try:
        known, _ = parser.parse_known_args(args)
    except argparse.ArgumentError:
        return dict.fromkeys(names)  # The full parser reports it, with its usage.
    return vars(known)


def parse_flags(
    command: type[Command],
    args: list[str],
    prog: str,
    default: Command | None = None,
    *,
    program: str = "adaafford ",
) -> Command:
    """Parse `args` as `command`; --help ends the process.

    Args:
        command: declares the flags.
        args: the arguments.
        prog: the subcommand, for the usage text.
        default: values of flags that are not given.
        program: text before the subcommand in the usage text.

    Raises:
        UsageError: a flag is unknown or missing, or a value is not allowed.
    """
    read = partial(tyro.cli, command, prog=f"{program}{prog}", default=default, config=FLAG_STYLE, registry=FLAG_TYPES)
    said = StringIO()
    try:
        with redirect_stderr(said):
            parsed: Command | None = read(args=args)
        if is_dataclass(parsed):
            # tyro does not look at the bounds of a dataclass's own fields.
            TypeAdapter(command).validate_python({each.name: getattr(parsed, each.name) for each in fields(parsed)})
    except SystemExit as stop:
        if stop.code != WRONG_FLAGS:
            raise
        raise UsageError(f"{_line_of(said.getvalue(), read)}; `{program}{prog} --help` says more") from None
    except ValidationError as error:
        problem = error.errors()[0]
        if isinstance(cause := problem.get("ctx", {}).get("error"), UsageError):
            raise cause from None
        name = ".".join(str(part) for part in problem["loc"])
        raise UsageError(f"flag for '{name}': {reason_of(problem)}; given {str(problem['input'])[:80]!r}") from None
    assert parsed is not None
    return parsed


def _line_of(box: str, read: Callable[..., object]) -> str:
    """What tyro says in a box about wrong flags, as one line.

    Args:
        box: what it printed: a text, below which there is help after a rule.
        read: parses arguments; gives the known flags by its --help.
    """
    lines = re.sub(r"\x1b\[[0-9;]*m", "", box).splitlines()
    # Where the terminal's encoding has no frames, the title is a row with a rule below it.
    framed = [line for line in lines if line.startswith("│")] or lines[2:]
    rows = [line[2:].rstrip(" │") for line in framed]
    whole = "\n".join(row if row.strip("─-") else RULE for row in rows)
    text = whole.partition(RULE)[0]
    if "Unrecognized options:" in box:
        unknown = whole.partition("Unrecognized options:")[2].partition(RULE)[0].replace(",", " ").split()
        wrong = next((word for word in unknown if word.startswith("-")), unknown[0])
        return f"unknown {wrong[:80]}{_near(wrong, read)}"
    if text.startswith("Missing from"):
        return f"missing: {', '.join(re.findall(r'^    (?! )(.+)$', text, re.MULTILINE))}"
    if found := re.search(SETTING, text, re.DOTALL):
        return _of_setting(*(" ".join((part or "").split()) for part in found.groups()))
    text = " ".join(text.split())
    for pattern, line in ONE_LINE:
        if found := re.search(pattern, text):
            return line(*found.groups())
    return text.removesuffix(".") or "the flags are wrong"


def _near(wrong: str, read: Callable[..., object]) -> str:
    """The known flag that is most like a wrong one, as a question; nothing where none is."""
    helped = StringIO()
    with redirect_stdout(helped), suppress(SystemExit):
        read(args=["--help"])
    near = difflib.get_close_matches(wrong, re.findall(r"(?<![\w-])--[a-z][\w.-]*", helped.getvalue()), n=1)
    return f"; did you mean {near[0]}?" if near else ""


def _flag(name: str) -> str:
    """A flag as it is written, from the place of its value."""
    return name if name.startswith("-") else f"--{name.removeprefix('settings.').replace('_', '-')}"


def _of_setting(name: str, below: str, problem: str, given: str) -> str:
    flag = _flag(f"{name}.{below}" if below else name)
    told = "" if problem.startswith(VALUE_ERROR) else f"; given {given}"
    return f"{flag}: {problem.removeprefix(VALUE_ERROR)}{told}"


def _of_several_kinds(name: str, kinds: str, given: str) -> str:
    kinds = kinds.removeprefix("{None}|").removesuffix("|{None}").strip("{}")
    allowed = ", ".join(sorted(kinds.split(","))) if "," in kinds else kinds
    return f"{_flag(name)}: given {' '.join(re.findall(QUOTED, given))}; allowed: {allowed}"


RULE = "\0"
WRONG_FLAGS = 2
"""Exit code of tyro."""
QUOTED = r"'([^']*)'"
SETTING = (
    r"Error parsing (\S+): \d+ validation\s+errors?\s+for\s+\w+\n(?:(\S+)\n)?  (\S.*?)\s\[type=.*?"
    r"input_value=(.*?),\s+input_type="
)
"""What pydantic says about a setting, whose name has a row of its own."""
ONE_LINE: tuple[tuple[str, Callable[..., str]], ...] = (
    (r"Error parsing (\S+): no type matching (.+?) could be instantiated from \[(.*?)\]\.", _of_several_kinds),
    (
        r"Error parsing (\S+): invalid literal for int\(\) with base 10: (.*)",
        lambda name, given: f"{_flag(name)}: given {given}; allowed: a whole number",
    ),
    (
        r"Error parsing (\S+): could not convert string to float: (.*)",
        lambda name, given: f"{_flag(name)}: given {given}; allowed: a number",
    ),
    (
        r"invalid choice '(.*?)' for argument '(\S+)'\. Expected one of \((.*)\)",
        lambda given, name, choices: f"{name}: given '{given}'; allowed: {choices.replace(chr(39), '').strip(', ')}",
    ),
    (r"Error parsing (\S+): (.*)", lambda name, problem: f"{_flag(name)}: {problem}"),
)
"""What tyro says about a value, and the line that says it."""


def dispatch(name: str, actions: Mapping[str, Action], args: list[str], operand: str) -> int:
    """Run the action of a command that is its first argument.

    Args:
        name: of the command, such as "store".
        actions: by name: what declares the flags, and what is run with them.
        args: those of the command.
        operand: what a usage line shows behind the action.

    Raises:
        UsageError: there is no such action, or a flag is wrong.
    """
    chosen, first = args[:1], next(iter(actions))
    if chosen in (["-h"], ["--help"]):
        print(
            f"usage: adaafford {name} {{{','.join(actions)}}} {operand}; `adaafford {name} {first} --help` shows more"
        )
        return 0
    if not chosen or chosen[0] not in actions:
        given = f"'{chosen[0]}'" if chosen else "nothing"
        raise UsageError(f"{name} needs one of {', '.join(actions)}; given {given}")
    command, execute = actions[chosen[0]]
    return execute(parse_flags(command, args[1:], f"{name} {chosen[0]}"))
