"""Known vulnerabilities of what is in requirements.lock and in the page.

Run: `python -m tests.repository.audit`.

Asks the advisory database of OSV in one request. If it is not available, that is printed in
capitals and the exit status is 0, with `--required` 2; it is 1 where an advisory matches that
nobody has looked at.

Source: https://google.github.io/osv.dev/post-v1-querybatch/.
"""

from __future__ import annotations

import json
import re
import sys
import urllib.error
import urllib.request
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

ROOT: Final = Path(__file__).parents[2]
LOCKS: Final = ("requirements.lock", "requirements-docs.lock", "requirements-fuzz.lock")
VENDOR: Final = ROOT / "daemon/onboard/monitoring/web/page/vendor"
DATABASE: Final = "https://api.osv.dev/v1/querybatch"
TIMEOUT_S: Final = 20.0
LARGEST_ANSWER_BYTES: Final = 10_000_000

REVIEWED: Final[Mapping[str, str]] = {}
"""Advisories that do not touch us, by name, and why; a person has looked. What is listed here and
matches nothing any more is complained of."""

_HEADERS: Final = {"leaflet": r"Leaflet (\d[\d.]*\d)", "uplot": r"uPlot \(v(\d[\d.]*\d)\)"}


class AuditError(Exception):
    """The database did not answer, or not as specified; the message gives the reason."""


@dataclass(frozen=True)
class Package:
    """What is installed or vendored, in exactly this version."""

    ecosystem: str
    name: str
    version: str

    @property
    def query(self) -> dict[str, Any]:
        """As the database takes it."""
        package = {"ecosystem": self.ecosystem, "name": self.name}
        return {"package": package, "version": self.version}


def packages() -> list[Package]:
    """All of the locks, those of other systems included, and the page's scripts."""
    text = "".join((ROOT / name).read_text(encoding="utf-8") for name in LOCKS)
    pinned = re.findall(r"^([A-Za-z0-9][A-Za-z0-9._-]*)==([^\s;]+)", text, re.MULTILINE)
    listed = [Package("PyPI", name, version) for name, version in sorted(set(pinned))]
    for name, header in _HEADERS.items():
        found = re.search(header, (VENDOR / f"{name}.js").read_text(encoding="utf-8")[:500])
        if found is None:
            raise AuditError(f"{name}.js does not say its version")
        listed.append(Package("npm", name, found[1]))
    return listed


def advisories(queried: list[Package], database: str = DATABASE) -> dict[Package, list[str]]:
    """Names of the advisories that match, by package; those without are left out.

    Raises:
        AuditError: no network, another answer than the one specified, or not all of it.
    """
    body = json.dumps({"queries": [package.query for package in queried]}).encode()
    request = urllib.request.Request(database, body, {"Content-Type": "application/json"})
    try:
        with urllib.request.urlopen(request, timeout=TIMEOUT_S) as answer:
            results = json.loads(answer.read(LARGEST_ANSWER_BYTES))["results"]
        if len(results) != len(queried):
            raise AuditError(f"{database}: {len(results)} answers to {len(queried)} questions")
        named = [[str(one["id"]) for one in result.get("vulns", ())] for result in results]
        if any(
            "next_page_token" in r and not names for r, names in zip(results, named, strict=True)
        ):
            raise AuditError(f"{database}: answers in pages; look at osv.dev yourself")
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        reason = getattr(error, "reason", error)
        raise AuditError(f"{database}: {reason}") from error
    # What has a further page and names on this one fails as it is.
    return {package: names for package, names in zip(queried, named, strict=True) if names}


def problems(found: Mapping[Package, list[str]], reviewed: Mapping[str, str]) -> list[str]:
    """A sentence for every advisory nobody has looked at, and every look that is out of date."""
    unseen = [
        f"{package.name} {package.version}: https://osv.dev/vulnerability/{name}; take a version "
        "without it, or have a person look at it and note it in tests/repository/audit.py"
        for package, names in found.items()
        for name in names
        if name not in reviewed
    ]
    matched = {name for names in found.values() for name in names}
    stale = [
        f"{name} matches nothing any more; take it out of tests/repository/audit.py"
        for name in reviewed
    ]
    return unseen + [
        sentence for sentence, name in zip(stale, reviewed, strict=True) if name not in matched
    ]


def main(arguments: list[str], database: str = DATABASE) -> int:
    """The exit status; see the top of this file."""
    queried = packages()
    try:
        found = advisories(queried, database)
    except AuditError as error:
        print(f"NOT AUDITED: {error}", file=sys.stderr)
        print("NOT AUDITED: run `make audit` where the network reaches it", file=sys.stderr)
        return 2 if "--required" in arguments else 0
    findings = problems(found, REVIEWED)
    for sentence in findings:
        print(sentence, file=sys.stderr)
    matching = sum(len(names) for names in found.values())
    print(f"{len(queried)} packages audited, {matching} advisories match, {len(findings)} problems")
    return 1 if findings else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
