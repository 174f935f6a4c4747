"""Fifty-two recordings: what we read is what gpsd read, or the difference has a reason.

The table is docs/reference/results/gpsd-recordings.md; `python -m tests.drivers.test_gpsd_corpus`
writes it.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Final

import pytest

from tests.drivers.gpsd_corpus import (
    CORPUS,
    OTHER_POSITION,
    Comparison,
    answer_of,
    compare,
    read_by_us,
    read_through_gpsd,
    recordings,
)
from tests.drivers.real_gpsd import PROGRAM

PAGE: Final = Path(__file__).parents[2] / "docs/reference/results/gpsd-recordings.md"
AT_ONCE: Final = 8
FLAT, NO_HEIGHT, NO_REPORT = (
    "2d, gpsd 3d",
    "height absent, gpsd has one",
    "no report of that time",
)
HEIGHT, ROLLED = "height, gpsd has none", "weeks rolled over"
LAST: Final = (
    "gpsd reports an epoch when its cycle has ended, and none before it knows the date: the first "
    "or last one of the recording has no report"
)
NO_GEOID: Final = (
    "GGA comes without the undulation: only a height above the geoid was received. gpsd computes "
    "the undulation from a grid of its own; ours is the setting `undulation_m`"
)
GSA_2D: Final = "GSA reports two dimensions: the height is held, not measured. gpsd passes it on"
RMC_FIRST: Final = (
    "an epoch of RMC or GLL alone has no height; gpsd goes on with the mode of the epoch before"
)
REASONS: Final = {
    ("blumax-gps009", NO_REPORT): LAST,
    (
        "bundg_zeus_9",
        OTHER_POSITION,
    ): "RMC, GGA and GLL of one time give positions up to 4 m apart; "
    "ours is GGA's, gpsd's the last one's",
    ("bundg_zeus_9", FLAT): RMC_FIRST,
    ("bundg_zeus_9", NO_REPORT): LAST,
    (
        "bundg_zeus_9",
        HEIGHT,
    ): "the report with GGA's height came under the time of another sentence",
    ("garmin-10x", FLAT): GSA_2D,
    ("garmin-10x", NO_HEIGHT): GSA_2D,
    ("geos-1m", NO_REPORT): LAST,
    ("humminbird-M37", NO_REPORT): "the recording's time goes backwards where it was joined",
    ("humminbird-M37", FLAT): NO_GEOID + "; epochs alternate between RMC, GLL and GGA",
    ("humminbird-M37", NO_HEIGHT): NO_GEOID,
    ("mtk-3301", NO_REPORT): LAST,
    ("mtk-3301", FLAT): GSA_2D,
    ("mtk-3301", NO_HEIGHT): GSA_2D,
    ("pharos-360", FLAT): RMC_FIRST,
    ("rgm3800", NO_REPORT): LAST,
    ("rgm3800", FLAT): GSA_2D,
    ("rgm3800", NO_HEIGHT): GSA_2D,
    ("telit-he910", FLAT): NO_GEOID,
    ("telit-he910", NO_HEIGHT): NO_GEOID,
    ("tn204", NO_REPORT): LAST,
    ("tn204", FLAT): "RMC and GGA come in turn, each with a time of its own: " + RMC_FIRST,
    ("ublox-f9p-rtcm", NO_REPORT): LAST,
    ("ublox-neo-m8p", NO_REPORT): LAST,
    ("ublox-neo-m8u", NO_REPORT): LAST,
    ("ublox-zed-f9p-hp", NO_REPORT): LAST,
    ("ublox-zed-f9p_hpg1.11", NO_REPORT): "gpsd's answer holds raw measurements and no positions",
    ("unicore-um621", FLAT): NO_GEOID,
    ("unicore-um621", NO_HEIGHT): NO_GEOID,
}
"""Why our decoders differ, by recording and kind of difference."""

RELEASE: Final = "the answers were made by a later release of gpsd than 3.22: "
THROUGH_GPSD: Final = {
    ROLLED: "gpsd 3.22 takes a date for one 1024 weeks later when it starts long after the "
    "recording",
    NO_REPORT: LAST,
    FLAT: RELEASE + "an epoch of RMC or GLL alone is 2d in 3.22, 3d later; ours as in 3.22",
    NO_HEIGHT: "gpsd reports a held height in two dimensions; it is absent here",
    HEIGHT: RELEASE + "reports of one time hold the height in another one of them",
    OTHER_POSITION: RELEASE
    + "3.22 reports the position of another sentence, or of the epoch before, "
    "under this time",
}
"""Why what comes through the real gpsd differs, by kind of difference."""

pytestmark = [
    pytest.mark.realtime,
    pytest.mark.trust,
    pytest.mark.skipif(
        not CORPUS.is_dir(), reason="needs the recordings in ../shared/data/nav/gpsd-daemon"
    ),
]


def compared_with_ours() -> dict[str, tuple[str, Comparison]]:
    found = {}
    for path in recordings():
        driver, samples = read_by_us(path)
        found[path.stem] = driver, compare(samples, answer_of(path))
    return found


def compared_through_gpsd(path: Path) -> Comparison:
    answer = answer_of(path)
    result = Comparison(0, len(answer))
    for patience in (1.0, 3.0, 10.0):
        result = compare(read_through_gpsd(path, patience=patience), answer)
        if result.compared >= least_of(path.stem, result):
            break
    return result


def as_markdown() -> str:
    """The page of differences."""
    lines = []
    for name, (driver, found) in compared_with_ours().items():
        kinds = "; ".join(
            f"{count} {kind}: {REASONS.get((name, kind), 'NO REASON')}"
            for kind, count in sorted(found.differences.items())
        )
        if not driver or not found.samples:
            kinds = kinds or "no positions: " + (
                "in gpsd's answer neither" if not found.epochs else "messages that only gpsd reads"
            )
        row = (name, driver or "gpsd only", found.samples, found.epochs, found.compared, kinds)
        lines.append("| " + " | ".join(map(str, row)) + " |")
    through = [f"| {kind} | {reason} |" for kind, reason in sorted(THROUGH_GPSD.items())]
    return HEAD + "\n".join(lines) + MIDDLE + "\n".join(through) + "\n"


HEAD: Final = """# Recordings of gpsd's tests, and where we differ

Reference. Recordings of receivers from gpsd's own tests with the answer that gpsd gave, read by our
decoders and, through Debian's gpsd 3.22, by our gpsd driver. Compared are time (2 ms), mode,
latitude and longitude (2e-7 degree) and height above the ellipsoid (2 cm). Written by
`python -m tests.drivers.test_gpsd_corpus`; do not edit.

## Read by our decoders

| recording | driver | samples | epochs of gpsd | compared | differences, and why |
|---|---|---|---|---|---|
"""
MIDDLE: Final = """

## Through the real gpsd

Every recording, also of receivers that only gpsd reads (Garmin, TSIP, SiRF, iTalk, Motorola,
Javad and others), is fed to gpsd at once. At least nine tenths of the epochs of its answer arrive;
but `trimble-res720-dr`, whose messages 3.22 does not know, and `ublox-8-time`, of which it reports
two thirds. In surveyed mode (`status` 7) a position is not measured: such reports are left out.

| difference | why |
|---|---|
"""
FEWER: Final = {"trimble-res720-dr": 0.0, "ublox-8-time": 0.5}
"""Share of the epochs that come at least, of those where 3.22 has fewer."""


def least_of(name: str, result: Comparison) -> float:
    """How many samples come at least through the real gpsd."""
    return FEWER.get(name, 0.9) * result.epochs


def test_our_decoders_read_what_gpsd_read_or_differ_for_a_reason() -> None:
    page = as_markdown()
    assert "NO REASON" not in page
    assert PAGE.read_text("utf-8") == page, "run: python -m tests.drivers.test_gpsd_corpus"


@pytest.mark.peer
@pytest.mark.skipif(PROGRAM is None, reason="gpsd is absent; install Debian's gpsd")
def test_through_the_real_gpsd_every_receiver_states_what_gpsd_read() -> None:
    paths = recordings()
    with ThreadPoolExecutor(AT_ONCE) as pool:
        found = dict(
            zip([p.stem for p in paths], pool.map(compared_through_gpsd, paths), strict=True)
        )
    for name, result in found.items():
        assert set(result.differences) <= set(THROUGH_GPSD), name
        # gpsd reports an epoch several times: what counts is that all of them came.
        assert result.compared >= least_of(name, result), (name, result)
        if name not in ("bundg_zeus_9", "ublox-8-time", "ublox-lea-4t"):
            assert not result.differences[OTHER_POSITION], (name, result)


if __name__ == "__main__":
    PAGE.write_text(as_markdown(), "utf-8")
