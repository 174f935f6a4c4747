"""`python -m tests.drivers.real_camera_table`: the table of real cameras in the drivers' reference.

Binds the head driver to every description in the collection of the tests, in each state, and
writes docs/reference/drivers/genicam-cameras.md.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Final

from drivers.contract import DeviceError
from sim_hw.gige.genicam.power_on_state import InitialState
from tests.drivers.test_real_descriptions import served
from tests.support.genicam_descriptions import names

PAGE: Final = Path(__file__).parents[2] / "docs" / "reference" / "drivers" / "genicam-cameras.md"
HEADER: Final = """# Real cameras by their GenICam description

Reference: the outcome of the driver `aravis` with the descriptions of real cameras.

The driver `aravis` is tried with the GenICam descriptions of {count} real cameras and frame
grabbers. The emulated head `sim_hw.gige.described_head` serves each description on the wire. It has
the camera's registers, selectors, availability and locks, and sends a test pattern for every
trigger. Its evaluation of the descriptions agrees with the reference implementation of GenApi.

Each camera is opened in three states: after power-on, with automatic functions on, and with the
values of another program (binning, mirroring, a test pattern, another trigger). The outcome is the
same in all three, but for the size of frames, which is left as the other program has set it.
`tests/drivers/test_real_descriptions.py` asserts it, and compares the pixels of one triggered
frame.

A description proves names and the order of writing. It does not prove the behaviour of the
hardware.

| description | outcome | frame | chunks | clock | what is missing |
|---|---|---|---|---|---|
"""


def row(name: str, number: int) -> str:
    """One row of the table."""
    outcomes = []
    for index, state in enumerate(InitialState):
        with served(name, state, 3 * number + index) as (_, driver, _memory):
            try:
                found = driver.bind()
                clock = "no" if found["clock"] == "no" else "yes"
                outcomes.append(f"armed | {found['frame']} | {found['chunks']} | {clock} | ")
            except DeviceError as refusal:
                reasons = [line.partition(": ")[2] for line in str(refusal).splitlines()]
                outcomes.append("refused | | | | " + "; ".join(reasons).replace("|", "/"))
    if len({re.sub(r"\d+ x \d+", "", outcome) for outcome in outcomes}) > 1:
        print(f"{name}: {outcomes}", file=sys.stderr)
    return f"| {name} | {outcomes[0]} |"


def main() -> None:
    """Write the page."""
    found = names()
    rows = [row(name, number) for number, name in enumerate(found)]
    PAGE.write_text(HEADER.format(count=len(found)) + "\n".join(rows) + "\n", encoding="utf-8")
    print(f"{PAGE}: {sum('| armed |' in row for row in rows)} of {len(rows)} armed")


if __name__ == "__main__":
    main()
