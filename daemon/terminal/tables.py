"""Light tables that fit a terminal of 80 columns."""

from __future__ import annotations

from rich import box
from rich.table import Table


def light_table(title: str, left: tuple[str, ...], right: tuple[str, ...]) -> Table:
    """A table with left-aligned words and then right-aligned figures."""
    table = Table(title=title, title_justify="left", box=box.SIMPLE, pad_edge=False, padding=0)
    for heading in left:
        table.add_column(heading)
    for heading in right:
        table.add_column(heading, justify="right", no_wrap=True)
    return table
