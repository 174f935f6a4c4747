"""`python -m tests.drivers.real_camera_table`: the table of real cameras in the drivers' reference.

Binds the head driver to every description in the collection of the tests, after power-on, and
writes docs/reference/drivers/genicam-cameras.md.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from pathlib import Path
from typing import Final

from drivers.contract import DeviceError
from sim_hw.gige.genicam.power_on_state import InitialState
from tests.support.genicam_descriptions import names

PAGE: Final = Path(__file__).parents[2] / "docs" / "reference" / "drivers" / "genicam-cameras.md"
HEADER: Final = """# Real cameras by their GenICam description

Reference: the outcome of the driver `aravis` with the descriptions of real cameras.

The driver `aravis` is tried with the GenICam descriptions of {count} real cameras and frame
grabbers. The emulated head `sim_hw.gige.described_head` serves each description on the wire. It has
the camera's registers, selectors, availability and locks, and sends a test pattern for every
trigger. Its evaluation of the descriptions agrees with the reference implementation of GenApi.

Each camera is opened in four states: after power-on, with automatic functions on, with the values
of another program (binning, mirroring, a test pattern, another trigger), and as the simplest camera
of its family, which implements only what a triggered frame needs. It is armed, or refused, in all
four. The frame is the one after power-on; another program may have left another size. The simplest
camera may be without chunks, clock and gain.

`tests/drivers/test_real_descriptions.py` compares outcome, chunks, clock, gain, packet size and
trigger line with what the reference implementation of GenApi reports, the pixels of one triggered
frame, and the rows of this table.

A description proves names and the order of writing. It does not prove the behaviour of the
hardware.

| description | outcome | frame | chunks | clock | what is missing |
|---|---|---|---|---|---|
"""


def armed_row(name: str, found: Mapping[str, str]) -> str:
    """The row of a camera that is armed, from what `bind` returns."""
    chunks, _, reason = found["chunks"].partition(": ")
    clock = "no" if found["clock"] == "no" else "yes"
    reason = f"chunks: {reason}" if reason else ""
    return f"| {name} | armed | {found['frame']} | {chunks} | {clock} | {reason} |"


def refused_row(name: str, sentence: str) -> str:
    """The row of a camera that is refused with this sentence."""
    return f"| {name} | refused | | | | {sentence} |"


@functools.cache
def rows_of_page() -> dict[str, str]:
    """The rows of the page by the name of the description."""
    _, _, table = PAGE.read_text(encoding="utf-8").partition("|---|")
    rows = [line for line in table.splitlines()[1:] if line.startswith("| ")]
    return {row.split("|")[1].strip(): row for row in rows}


def row(name: str, number: int) -> str:
    """One row of the table."""
    # The test imports this module for the rows.
    from tests.drivers.test_real_descriptions import served

    with served(name, InitialState.FACTORY, number) as (_, driver, _memory):
        try:
            return armed_row(name, driver.bind())
        except DeviceError as refusal:
            return refused_row(name, str(refusal).partition(": ")[2])


def main() -> None:
    """Write the page."""
    found = names()
    rows = [row(name, number) for number, name in enumerate(found)]
    PAGE.write_text(HEADER.format(count=len(found)) + "\n".join(rows) + "\n", encoding="utf-8")
    print(f"{PAGE}: {sum('| armed |' in row for row in rows)} of {len(rows)} armed")


if __name__ == "__main__":
    main()
