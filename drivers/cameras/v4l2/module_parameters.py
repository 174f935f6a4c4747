"""Parameters of kernel modules that decide how a sensor runs, such as its trigger mode.

They are set when the module is loaded, by the administrator; they are only checked here.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Final

MODULES: Final = Path("/sys/module")
ASSIGNMENT: Final = re.compile(r"([A-Za-z0-9_]+)/([A-Za-z0-9_]+)=([A-Za-z0-9_.,-]+)")
BOOLEANS: Final = {"Y": "1", "N": "0"}
"""How the kernel prints a parameter that is true or false."""


def wrong_parameters(wanted: Sequence[str], *, modules: Path = MODULES) -> list[str]:
    """Compare parameters with what the kernel has.

    Args:
        wanted: `module/parameter=value` each.
        modules: where the kernel lists its modules.

    Returns:
        A sentence with the remedy for each parameter that has another value.

    Example:
        >>> wrong_parameters(["imx296/trigger_mode=1"], modules=Path("/nowhere"))[0][:61]
        'module_parameters has imx296/trigger_mode=1; the kernel has n'
    """
    problems = []
    for text in wanted:
        match = ASSIGNMENT.fullmatch(text)
        if match is None:
            continue  # refused with the settings
        module, parameter, value = match.groups()
        try:
            found = (
                (modules / module / "parameters" / parameter).read_text(encoding="utf-8").strip()
            )
        except PermissionError:
            problems.append(
                f"module_parameters has {text}; the kernel does not let this user read it, leave "
                "it out"
            )
            continue
        except OSError:
            problems.append(
                f"module_parameters has {text}; the kernel has no such parameter of a loaded "
                f"module, see modinfo {module}"
            )
            continue
        if found != value and BOOLEANS.get(found, found) != BOOLEANS.get(value, value):
            problems.append(
                f"module_parameters has {text}; it is {found}. Write 'options {module} "
                f"{parameter}={value}' to a file below /etc/modprobe.d and restart"
            )
    return problems
