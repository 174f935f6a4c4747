"""Heads that a discovery found, for tests of new configurations."""

from __future__ import annotations

from dataclasses import replace

from drivers.cameras.head_description import HeadDescription


def head(number: int = 1, **changes: object) -> HeadDescription:
    """A monochrome GigE Vision head of 1200 x 800 pixels."""
    address = f"127.0.0.{number}"
    found = HeadDescription(
        driver="aravis",
        model="M-12",
        serial=f"S{number}",
        place=address,
        width_px=1200,
        height_px=800,
        pixel_format="Mono12",
        bits=12,
        full_width_px=1200,
        full_height_px=800,
        settings={
            "address": address,
            "serial": f"S{number}",
            "pixel_format": "Mono12",
            "width_px": 1200,
            "height_px": 800,
        },
    )
    # Any field of a head by name.
    return replace(found, **changes)  # type: ignore[arg-type]


def heads(count: int) -> list[HeadDescription]:
    """Heads with the addresses 127.0.0.1 and following."""
    return [head(number) for number in range(1, count + 1)]
