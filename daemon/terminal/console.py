"""Console output, with markup and control sequences of foreign text disabled.

No text is markup, and no character of it moves the cursor, changes colours or turns the reading
direction. Commands print through `Console`; styles are given as arguments.
"""

from __future__ import annotations

import unicodedata
from collections.abc import Iterable
from typing import Any

from rich import box
from rich import console as rich_console
from rich.segment import Segment
from rich.table import Table

_REPLACED = {code: 0x2400 + code for code in range(0x20) if code not in (0x09, 0x0A)} | {
    0x7F: 0x2421,
    **dict.fromkeys(range(0x80, 0xA0), 0xFFFD),
}
"""Control characters by their visible pictures (Unicode, Control Pictures)."""


def visible(text: str) -> str:
    """The text with what cannot be seen replaced, character by character; its width stays."""
    if text.isprintable():
        return text
    shown = text.translate(_REPLACED)
    return "".join("\ufffd" if unicodedata.category(c) in ("Cf", "Cs") else c for c in shown)


def visible_value(value: Any) -> Any:
    """A value of a page's template, its text made visible; what is markup of ours stays."""
    return visible(value) if type(value) is str else value


class Console(rich_console.Console):  # noqa: TID251
    """A terminal for text of others: without markup, and without what cannot be seen.

    Example:
        >>> Console(width=40).print("[/x] \\x1b[2J")
        [/x] ␛[2J
    """

    def __init__(self, **settings: Any) -> None:
        super().__init__(markup=False, emoji=False, **settings)

    def render(
        self,
        renderable: rich_console.RenderableType,
        options: rich_console.ConsoleOptions | None = None,
    ) -> Iterable[Segment]:
        """The segments of anything that is printed, whatever it was made of."""
        for segment in super().render(renderable, options):
            if segment.control is None:
                yield Segment(visible(segment.text), segment.style)
            else:
                yield segment


def light_table(title: str, left: tuple[str, ...], right: tuple[str, ...]) -> Table:
    """A table with left-aligned words and then right-aligned figures."""
    table = Table(title=title, title_justify="left", box=box.SIMPLE, pad_edge=False, padding=0)
    for heading in left:
        table.add_column(heading)
    for heading in right:
        table.add_column(heading, justify="right", no_wrap=True)
    return table
