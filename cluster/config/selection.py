"""The user's selection of objects, which flags and files of several commands share."""

from pathlib import Path
from typing import Annotated, Any

import tyro
from pydantic import Field, field_validator, model_validator

from shared.config import StrictModel
from shared.tasks import TASK_FILE_SUFFIX, Task, read_task, task_named


class ObjectSelection(StrictModel):
    """Settings of task and objects; other settings inherit from it, so its flags have no prefix.

    If `task` is a TOML file, the settings contain the definition, and the file is not needed any more.
    """

    task: str | None = None
    """Which manipulation task: a name, or a TOML file that defines one."""
    task_definition: Annotated[Task | None, tyro.conf.Suppress] = Field(None, exclude_if=lambda task: task is None)
    """What the file said."""
    objects: Path | None = None
    """A folder of objects in PartNet-Mobility's layout; default: procedural objects."""
    object_list: Path | None = None
    """Only the objects of this list, `<id> <category>` a line, such as Where2Act publishes."""
    categories: tuple[str, ...] = ()
    """Only objects of these; "train" and "test" stand for the paper's ten and five. Default: all."""

    @property
    def task_record(self) -> Task:
        """The task; raises as `task_named` does."""
        assert self.task is not None, "only settings that name a task are asked for it"
        return self.task_definition or task_named(self.task)

    @model_validator(mode="before")
    @classmethod
    def _defined_task(cls, values: Any) -> Any:
        """A flag may name another task than the one that a file of settings defines."""
        if not isinstance(values, dict):
            return values
        task, defined = values.get("task"), values.get("task_definition")
        if isinstance(task, str) and task.endswith(TASK_FILE_SUFFIX):
            defined = read_task(Path(task))
            return values | {"task": defined.name, "task_definition": defined}
        name = defined.get("name") if isinstance(defined, dict) else getattr(defined, "name", None)
        return values | {"task_definition": defined if name == task else None}

    @field_validator("objects", "object_list")
    @classmethod
    def _absolute(cls, path: Path | None) -> Path | None:
        """A run may be resumed from another working folder."""
        return None if path is None else path.expanduser().resolve()
