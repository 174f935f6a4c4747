"""A laboratory series as the emulated instruments write it, and the command that records one.

The images and their metadata come from the instruments: `sphere`, `collimator`,
`calibration_field`.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from processing.rig import Rig, RigError, load_rig, shipped_rigs
from sim_hw.world.atomic_file import atomic_file

DATE: Final = "2026-11-21"
"""The same of every series: the same call writes the same bytes."""


def command(name: str, description: str | None) -> argparse.ArgumentParser:
    """The options that all instruments have."""
    line = argparse.ArgumentParser(prog=f"python -m sim_hw.{name}", description=description)
    line.add_argument("rig", help="name of a shipped rig, or a rig file")
    line.add_argument("--out", type=Path, required=True, help="a new folder for series and truth")
    line.add_argument("--seed", type=int, default=1, help="seed for all random generators")
    line.add_argument("--take", type=int, default=1, help="2: the same parts, calibrated again")
    return line


def run(
    line: argparse.ArgumentParser,
    arguments: Sequence[str] | None,
    take: Callable[[Rig, Path, argparse.Namespace], Path],
) -> int:
    """Read the command line and the rig file, take the series, print where it is."""
    given = line.parse_args(arguments)
    try:
        file = shipped_rigs().get(given.rig, Path(given.rig))
        rig = load_rig(file)
    except RigError as error:
        print(error, file=sys.stderr)
        return 2
    print(json.dumps({"series": str(take(rig, file, given))}))
    return 0


def new_series(out: Path, rig_file: Path) -> Path:
    """The folder of a series, with the rig file; the folder `truth` is next to it."""
    series = out / "series"
    series.mkdir(parents=True)
    (out / "truth").mkdir()
    (series / "rig.toml").write_bytes(rig_file.read_bytes())
    return series


def write_list(
    series: Path,
    kind: str,
    *,
    source: str,
    serials: Mapping[str, str],
    images: Sequence[Mapping[str, Any]],
    **content: Any,
) -> None:
    """`series.json`, written last."""
    record = {
        "format": 1,
        "kind": kind,
        "date": DATE,
        "source": source,
        "simulated": True,
        "serials": dict(serials),
        **content,
        "images": images,
    }
    with atomic_file(series / "series.json") as part:
        part.write_text(json.dumps(record, indent=1))
