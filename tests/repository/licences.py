"""The licence of everything in requirements.lock, and what may not be.

Run: `python -m tests.repository.licences`.

Licences are those the installed packages state of themselves. `--write` writes
docs/reference/contributing/licences.md; without it the exit status is 1 where a licence is on no
list or the page is not current.
"""

from __future__ import annotations

import re
import sys
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Final

from packaging.markers import Marker
from packaging.requirements import Requirement

ROOT: Final = Path(__file__).parents[2]
PAGE: Final = ROOT / "docs/reference/contributing/licences.md"

PERMISSIVE: Final = frozenset(
    {
        *("0BSD", "Apache-2.0", "Apache-2.0 WITH LLVM-exception", "BSD-2-Clause", "BSD-3-Clause"),
        *("BSD", "CC0-1.0", "ISC", "MIT", "MIT-0", "MIT-CMU", "PSF-2.0", "Zlib"),
    }
)
"""May be part of anything. BSD: one of its permissive forms, not stated which."""

EXCEPTIONS: Final[Mapping[str, str]] = {
    "certifi": "MPL-2.0: a list of certificates, unchanged; comes with pyproj and rasterio",
    "pycairo": "LGPL-2.1 or MPL-1.1: comes with PyGObject, is not imported by us",
    "pygobject": "LGPL-2.1+: imported, unchanged; only for heads over Aravis, itself LGPL",
    "pymavlink": "LGPL-3: imported, unchanged; only where MAVLink is wanted",
    "zeroconf": "LGPL-2.1+: imported, unchanged; only for the operator's page",
}
"""Weak copyleft that a person has looked at: used as it is, as a package of its own, replaceable by
whoever gets the product."""

TOOLS_ONLY: Final = frozenset({"MPL-2.0", "Unlicense"})
"""Besides the permissive ones, for tools of development that are never delivered."""

_NAMES: Final[Mapping[str, str]] = {
    "Apache Software License": "Apache-2.0",
    # GenICam's own identifier for the text of BSD-3-Clause.
    "LicenseRef-GenICam-1.6": "BSD-3-Clause",
    "BSD License": "BSD",
    "ISC License (ISCL)": "ISC",
    "MIT License": "MIT",
    "Mozilla Public License 2.0 (MPL 2.0)": "MPL-2.0",
    "The Unlicense (Unlicense)": "Unlicense",
    "Python Software Foundation License": "PSF-2.0",
    "GNU Lesser General Public License v2 or later (LGPLv2+)": "LGPL-2.1-or-later",
    "GNU Lesser General Public License v3 (LGPLv3)": "LGPL-3.0",
}
_BY_FILE: Final[Mapping[str, str]] = {
    # LICENSE in its wheel; RTKLIB, which is compiled into it, is BSD-2-Clause.
    "pyrtklib5": "MIT AND BSD-2-Clause",
}
"""Licences of packages whose metadata state none."""
_SPDX: Final = re.compile(r"[A-Za-z0-9.+-]+(?: WITH [A-Za-z0-9.-]+)?")


@dataclass(frozen=True)
class Package:
    """A package of the lock; `licence` is empty if it is not installed or states none."""

    name: str
    licence: str
    is_tool: bool

    @property
    def problem(self) -> str | None:
        """Why it may not be used, in a sentence; None where it may."""
        if self.name in EXCEPTIONS and not self.is_tool:
            return None
        allowed = PERMISSIVE | TOOLS_ONLY if self.is_tool else PERMISSIVE
        if self.licence and _is_allowed(self.licence, allowed):
            return None
        what = "a tool of development" if self.is_tool else "part of the product"
        return (
            f"{self.name} is {what} under {self.licence or 'a licence it does not state'}; "
            "replace it, or have a person look at it and note it in tests/repository/licences.py"
        )


def packages(lock: str = "requirements.lock") -> tuple[list[Package], list[str]]:
    """Those of a lock that are installed here, and the names of those that are not."""
    delivered = _closure(_product_requirements())
    found, absent = [], []
    for name, is_meant in _locked(lock).items():
        try:
            if not is_meant:
                raise metadata.PackageNotFoundError(name)
            about = metadata.metadata(name).json
        except metadata.PackageNotFoundError:
            absent.append(name)
            continue
        classifiers = about.get("classifier", [])
        licence = stated(
            str(about.get("license_expression", "")),
            str(about.get("license", "")),
            classifiers if isinstance(classifiers, list) else [classifiers],
        )
        found.append(Package(name, licence or _BY_FILE.get(name, ""), name not in delivered))
    return found, absent


def stated(expression: str, text: str, classifiers: Iterable[str]) -> str:
    """The licence by a package's metadata, as SPDX if it can be determined."""
    if expression:
        return expression
    text = text.strip()
    if text in _NAMES:
        return _NAMES[text]
    classified = [
        _NAMES.get(name, name)
        for entry in classifiers
        if entry.startswith("License ::")
        and (name := entry.rpartition("::")[2].strip()) not in ("OSI Approved", "DFSG approved")
    ]
    if "\n" not in text and _SPDX.fullmatch(re.split(" OR | AND ", text)[0]) and "-" in text:
        return text
    return " AND ".join(classified) or (text if text in PERMISSIVE else "")


def page(found: Iterable[Package]) -> str:
    """The page docs/reference/contributing/licences.md."""
    listed = sorted(found, key=lambda package: package.name)
    lines = [
        "# Licences",
        "",
        "Reference. Syntopic is under Apache-2.0. The licences of the packages in "
        "requirements.lock,",
        "written by `python -m tests.repository.licences --write` and checked by a test:",
        "",
        "## In the product",
        "",
        "| package | licence | looked at |",
        "|---|---|---|",
        *(
            f"| {p.name} | {p.licence} | {EXCEPTIONS.get(p.name, '')} |"
            for p in listed
            if not p.is_tool
        ),
        "",
        "Vendored with the page: Leaflet (BSD-2-Clause) and uPlot (MIT), with their licences next "
        "to",
        "them. Wheels carry libraries of their own whose licences are in the wheels: OpenBLAS and",
        "the GCC runtime in numpy and scipy, FFmpeg (LGPL) in opencv, GDAL and PROJ in rasterio",
        "and pyproj.",
        "Vendored with the documents' site: iframe-worker (MIT), with its licence next to it.",
        "From Debian, never delivered with it: Aravis (LGPL-2.1+), gpsd (BSD-2-Clause).",
        "",
        "## Tools of development, never delivered",
        "",
        "| package | licence |",
        "|---|---|",
        *(f"| {p.name} | {p.licence} |" for p in listed if p.is_tool),
        "",
        "The packages of requirements-docs.lock build the documents' site. A test requires of them",
        "the same licences.",
        "",
    ]
    return "\n".join(lines)


def main(arguments: list[str]) -> int:
    found, absent = packages()
    problems = [problem for package in found if (problem := package.problem)]
    if "--write" in arguments:
        PAGE.write_text(page(found), encoding="utf-8")
    elif PAGE.read_text(encoding="utf-8") != page(found):
        problems.append(
            f"{PAGE.name} is not current; run python -m tests.repository.licences --write"
        )
    for problem in problems:
        print(problem, file=sys.stderr)
    print(f"{len(found)} packages looked at, {len(absent)} of other systems not installed here")
    return 1 if problems else 0


def _is_allowed(licence: str, allowed: frozenset[str]) -> bool:
    """Every part of an AND, one part of an OR. Brackets are not understood, so not allowed."""
    return any(
        all(part.strip() in allowed for part in choice.split(" AND "))
        for choice in licence.split(" OR ")
    )


def _locked(lock: str) -> dict[str, bool]:
    """Packages of a lock, and whether this system is one that it pins them for."""
    text = (ROOT / lock).read_text(encoding="utf-8")
    pinned = re.findall(r"^([\w.-]+)==[^\s;]+ *(?:; *([^\\\n]+))?", text, re.MULTILINE)
    meant = {name for name, marker in pinned if not marker or Marker(marker).evaluate()}
    return {name: name in meant for name in sorted({name for name, _ in pinned})}


def _product_requirements() -> list[str]:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = project.get("optional-dependencies", {})
    return [*project["dependencies"], *(one for listed in extras.values() for one in listed)]


def _closure(requirements: Iterable[str]) -> set[str]:
    """Names of everything that these need on this machine, extras of ours included."""
    waiting = [(Requirement(text), "") for text in requirements]
    seen: set[tuple[str, str]] = set()
    names: set[str] = set()
    while waiting:
        requirement, extra = waiting.pop()
        if requirement.marker and not requirement.marker.evaluate({"extra": extra}):
            continue
        name = re.sub(r"[-_.]+", "-", requirement.name).lower()
        names.add(name)
        for wanted in ("", *requirement.extras):
            if (name, wanted) in seen:
                continue
            seen.add((name, wanted))
            try:
                needed = metadata.requires(name) or []
            except metadata.PackageNotFoundError:
                continue
            waiting += [(Requirement(text), wanted) for text in needed]
    return names


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
