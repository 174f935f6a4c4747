"""The pages that are generated from the code."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache

from docs._site import commands, interfaces, python_api


@cache
def generated_pages() -> Mapping[str, str]:
    """Text of every generated page by its path below docs/."""
    return commands.pages() | interfaces.pages() | python_api.pages()
