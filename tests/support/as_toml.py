"""Settings as a TOML file, for commands that a test starts."""

import json
from collections.abc import Mapping
from typing import Any


def as_toml(values: Mapping[str, Any], prefix: str = "") -> str:
    """Nested settings as TOML; what is None is left to its default, since TOML has no word for it."""
    lines, tables = [], []
    for name, value in values.items():
        if isinstance(value, Mapping):
            tables.append(f"[{prefix}{name}]\n{as_toml(value, f'{prefix}{name}.')}")
        elif value is not None:
            # Numbers, booleans, strings and arrays of these are written alike in JSON and TOML.
            lines.append(f"{name} = {json.dumps(value)}\n")
    return "".join(lines + tables)
