"""What the sections of `service.toml` share: strictness, lists, and paths of files."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, TypeVar

from pydantic import AfterValidator, BaseModel, ConfigDict, Strict, ValidationInfo


def _in_folder(path: Path, info: ValidationInfo) -> Path:
    """The path relative to the folder of the file, if that is in the context of the validation."""
    return info.context["folder"] / path if info.context else path


Item = TypeVar("Item")
Several = Annotated[tuple[Item, ...], Strict(False)]
FilePath = Annotated[Path, Strict(False), AfterValidator(_in_folder)]


class ConfigurationSection(BaseModel):
    model_config = ConfigDict(
        extra="forbid", frozen=True, strict=True, allow_inf_nan=False, use_attribute_docstrings=True
    )
