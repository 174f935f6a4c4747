"""`syntopic schema`: the JSON Schema of a file, for editors."""

from __future__ import annotations

import sys
from enum import StrEnum
from typing import Annotated

import typer

HELP = """Print the JSON Schema of rig.toml or service.toml for an editor.

An editor with TOML support, such as VS Code with Even Better TOML, then completes keys and marks
mistakes. The first line of the TOML file names the schema: `#:schema ./service.schema.json`.

Example: `syntopic schema service > service.schema.json`
"""


class SchemaName(StrEnum):
    """Files that have a schema."""

    RIG = "rig"
    SERVICE = "service"


def schema(
    name: Annotated[SchemaName, typer.Argument(help="The file: rig or service.")],
) -> None:
    from daemon.configuration.schemas import SCHEMA_FILES

    sys.stdout.write(SCHEMA_FILES[name].read_text(encoding="utf-8"))
