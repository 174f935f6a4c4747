"""Files of other distributions in Syntopic's packages.

The packages have general names (`daemon`, `drivers`, ...), and pip lets two distributions install
into one folder: `python-daemon` installs a package `daemon` as well.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from importlib import metadata
from typing import Final

from daemon.configuration.model import Configuration
from daemon.onboard.preflight.check_results import CheckResult, failed
from processing.rig import Rig

IMPORT_NAMES: Final = ("daemon", "drivers", "processing", "sim_hw")
OWN_DISTRIBUTIONS: Final = frozenset({"syntopic", "syntopic-scenes"})
_OWN_FILE: Final = re.compile(
    rf"^(?:{'|'.join(IMPORT_NAMES)})(?:/[^,\n]*|\.(?:py|so))", re.MULTILINE
)


def foreign_files(
    distributions: Iterable[metadata.Distribution] | None = None,
) -> dict[str, str]:
    """The first file that each other distribution has in Syntopic's packages.

    Args:
        distributions: None takes all that this interpreter finds.
    """
    found = {}
    for distribution in metadata.distributions() if distributions is None else distributions:
        name = distribution.metadata["Name"]
        if name in OWN_DISTRIBUTIONS:
            continue
        listed = distribution.read_text("RECORD") or distribution.read_text("top_level.txt") or ""
        match = _OWN_FILE.search(listed.replace("\\", "/")) or re.search(
            rf"^(?:{'|'.join(IMPORT_NAMES)})$", listed, re.MULTILINE
        )
        if match is not None:
            found[name] = match[0]
    return found


def import_names(_configuration: Configuration, _rig: Rig) -> Iterator[CheckResult]:
    """Every other distribution that installed a file into Syntopic's packages."""
    for name, file in foreign_files().items():
        yield failed(
            "installation",
            name,
            f"{name} installs {file} into Syntopic's packages. Install Syntopic in a virtual "
            f"environment of its own, or run: pip uninstall {name} && pip install "
            "--force-reinstall --no-deps syntopic",
        )
