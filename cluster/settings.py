"""From defaults, a preset, a file and flags to one validated model: later ones win, and every setting has a flag."""

import argparse
from pathlib import Path
from typing import Any, TypeVar

import tyro
from pydantic import BaseModel, ValidationError

from shared.configuration import load_toml, merge, parse
from shared.errors import UsageError

PRESETS_FOLDER = Path(__file__).parent / "presets"

Model = TypeVar("Model", bound=BaseModel)
Command = TypeVar("Command")

FLAG_STYLE = (tyro.conf.AvoidSubcommands, tyro.conf.EnumChoicesFromValues)


def preset_names() -> list[str]:
    """The presets that the package brings."""
    return sorted(path.stem for path in PRESETS_FOLDER.glob("*.toml"))


def preset(name: str) -> dict[str, Any]:
    """The settings of a preset.

    Raises:
        UsageError: there is no such preset; the message lists those there are.
    """
    if name not in preset_names():
        raise UsageError(f"unknown preset '{name}'; allowed: {', '.join(preset_names())}")
    return load_toml(PRESETS_FOLDER / f"{name}.toml")


def layered(model: type[Model], preset_name: str | None, file: Path | None) -> Model:
    """The model's defaults under a preset under a TOML file; what flags are then laid over.

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
    """The values of a few flags that decide the defaults of all others, before those are parsed."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    for name in names:
        parser.add_argument(f"--{name}")
    try:
        known, _ = parser.parse_known_args(args)
    except argparse.ArgumentError:
        return dict.fromkeys(names)  # The full parser reports it, with its usage.
    return vars(known)


def parse_flags(command: type[Command], args: list[str], prog: str, default: Command | None = None) -> Command:
    """Parse `args` as `command`; a mistake in the flags themselves ends the process with code 2.

    Raises:
        UsageError: a value is of the right type but not allowed.
    """
    try:
        parsed = tyro.cli(command, prog=f"adaafford {prog}", args=args, default=default, config=FLAG_STYLE)
    except ValidationError as error:
        problem = error.errors()[0]
        name = ".".join(str(part) for part in problem["loc"])
        raise UsageError(f"flag for '{name}': {problem['msg']}; given {str(problem['input'])[:80]!r}") from None
    assert parsed is not None
    return parsed


def difference(before: dict[str, Any], after: dict[str, Any], prefix: str = "") -> str | None:
    """The first setting in which two configurations differ, as "name: before, now after"; None if they agree."""
    for key in sorted(before.keys() | after.keys()):
        old, new = before.get(key), after.get(key)
        if isinstance(old, dict) and isinstance(new, dict):
            found = difference(old, new, f"{prefix}{key}.")
            if found:
                return found
        elif old != new:
            return f"'{prefix}{key}' was {old!r}, is now {new!r}"
    return None
