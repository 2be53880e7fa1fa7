"""Which objects a command works with, as far as the user says so; flags and files of several commands share this."""

from pathlib import Path
from typing import Annotated

from pydantic import AfterValidator, field_validator

from shared.configuration import StrictModel


def _without_credentials(address: str) -> str:
    if "@" in address:
        raise ValueError("an address may hold no user and password; Ray takes its token from RAY_AUTH_TOKEN")
    return address


RayAddress = Annotated[str, AfterValidator(_without_credentials)]
"""Of a Ray cluster; it is kept and shown, so that it may hold no secret."""


class ObjectSelection(StrictModel):
    """What a command's settings say of its objects; settings inherit it, so that its flags have no prefix."""

    objects: Path | None = None
    """A folder of objects in PartNet-Mobility's layout; built-in procedural objects where none is given."""
    object_list: Path | None = None
    """Only the objects of this list, `<id> <category>` a line, such as Where2Act publishes."""
    categories: tuple[str, ...] = ()
    """Only objects of these; "train" and "test" stand for the paper's ten and five. All where none is named."""

    @field_validator("objects", "object_list")
    @classmethod
    def _absolute(cls, path: Path | None) -> Path | None:
        """A run may be resumed from another working folder."""
        return None if path is None else path.expanduser().resolve()
