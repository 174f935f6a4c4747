"""The link budget as tables, one for each interface that leads to heads."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from daemon.terminal.console import Console
from daemon.terminal.tables import light_table


def print_links(console: Console, links: Sequence[Mapping[str, Any]]) -> None:
    """Print the budget of every link.

    Args:
        console: where.
        links: as `daemon.onboard.preflight.link_tables.link_tables` returns them.
    """
    for link in links:
        table = light_table(
            _title(link),
            ("head",),
            ("packet B", "packets", "MB", "Mbit/s", "pause us", "start ms", "end ms"),
        )
        for head in link["heads"]:
            end_s = head["transfer_delay_us"] * 1e-6 + head["transfer_s"]
            table.add_row(
                head["head"],
                str(head["packet_size"]),
                str(head["packets"]),
                f"{head['wire_bytes'] / 1e6:.2f}",
                f"{head['rate_mbps']:.1f}",
                f"{head['packet_delay_us']:.1f}",
                f"{head['transfer_delay_us'] * 1e-3:.1f}",
                f"{end_s * 1e3:.0f}",
            )
        console.print(table)


def _title(link: Mapping[str, Any]) -> str:
    verdict = "fits" if link["fits"] else "does not fit"
    return (
        f"{link['interface']}, {link['rate_mbps']:g} Mbit/s: {link['wire_bytes'] / 1e6:.1f} MB on "
        f"the wire take {link['needed_s']:.2f} s of {link['interval_s']:g} s ({verdict}, "
        f"{link['usable_s']:.2f} s are usable)"
    )
