"""Output of every calibration: a dated folder with numbers, a comparison and a report.

A calibration is never overwritten: its folder is new, complete when it has its name, and holds
`calibration.json` (what programs read, the next calibration's "previous") and `report.html`
(self-contained). Measurement and adjustment are in each calibration.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final, Protocol

import jinja2
import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from daemon import DaemonError
from daemon.mission.canonical_json import canonical_bytes
from daemon.mission.store.durable import create_file, make_directories, new_files
from daemon.terminal.console import visible_value

CALIBRATION_FORMAT: Final = 1
CALIBRATION_MAX_BYTES: Final = 50_000_000
FAMILY_ALPHA: Final = 0.01
"""Probability that a comparison of two equal calibrations calls any change significant."""

HIGH_CORRELATION: Final = 0.9
CORRELATION_ROWS_MAX: Final = 30

Cell = str | float | int | None


class CalibrationFolderError(DaemonError, ValueError):
    """A calibration that cannot be written or compared; the message states what would be right."""


@dataclass(frozen=True)
class Quantity:
    """One calibrated number with its standard deviation (None: not known), both in `unit`.

    `where` is the head, sensor or lens, `what` the parameter; the pair is unique.
    """

    where: str
    what: str
    unit: str
    value: float
    sigma: float | None


@dataclass(frozen=True)
class QuantityChange:
    """A quantity against the previous calibration. `sigma` is that of the difference, `t` the
    difference over it; `limit` is what `t` exceeds when the change is significant."""

    where: str
    what: str
    unit: str
    old: float
    new: float
    sigma: float | None
    limit: float

    @property
    def t(self) -> float | None:
        if not self.sigma:
            return None
        return (self.new - self.old) / self.sigma

    @property
    def significant(self) -> bool | None:
        """None: without a standard deviation there is no verdict."""
        return None if self.t is None else abs(self.t) > self.limit


@dataclass(frozen=True)
class ReportTable:
    """A table of the report: headings, rows as long as these, and a sentence below."""

    title: str
    headings: tuple[str, ...]
    rows: Sequence[Sequence[Cell]]
    note: str = ""


class NamedParameter(Protocol):
    """An estimated number: of what, and which."""

    @property
    def where(self) -> str: ...

    @property
    def what(self) -> str: ...


def correlation_table(
    parameters: Sequence[NamedParameter], covariance: NDArray[np.float64]
) -> ReportTable:
    """The pairs of parameters that the measurement hardly separates.

    Args:
        parameters: names of the rows, n.
        covariance: (n, n), positive definite.

    Returns:
        Pairs with a correlation beyond `HIGH_CORRELATION`, the highest first.
    """
    spread = np.sqrt(np.diag(covariance))
    correlation = covariance / spread[:, None] / spread
    i, j = np.triu_indices(len(parameters), 1)
    order = np.argsort(-np.abs(correlation[i, j]))
    high = [k for k in order.tolist() if abs(correlation[i[k], j[k]]) > HIGH_CORRELATION]
    names = [f"{one.where} {one.what}" for one in parameters]
    return ReportTable(
        f"Correlations beyond {HIGH_CORRELATION:g}",
        ("one", "other", "correlation"),
        [
            (names[i[k]], names[j[k]], f"{correlation[i[k], j[k]]:+.3f}")
            for k in high[:CORRELATION_ROWS_MAX]
        ],
        f"{len(high)} of {len(i)} pairs; all of them are in covariance.npz.",
    )


@dataclass(frozen=True)
class Plot:
    """A drawing of the report, SVG of our own making, and the sentence under it."""

    title: str
    svg: str
    note: str = ""


@dataclass(frozen=True)
class CalibrationReport:
    """Report of one calibration.

    Attributes:
        kind: the command's name, such as `radiometric`.
        calibration_id, date: of the new calibration.
        facts: what was measured where, in pairs.
        serials: head, lens or probe by name, and its serial number ("" where it has none).
        quantities: everything the next calibration will be compared with.
        figures: numbers for programs, JSON types only.
        verdicts: sentences for a person; those of `warnings` are printed as such.
        changes: against `previous` (its id), empty where there was none.
    """

    kind: str
    title: str
    calibration_id: str
    date: str
    facts: Sequence[tuple[str, str]]
    serials: Mapping[str, str]
    quantities: Sequence[Quantity]
    figures: Mapping[str, Any] = field(default_factory=dict)
    verdicts: Sequence[str] = ()
    warnings: Sequence[str] = ()
    tables: Sequence[ReportTable] = ()
    plots: Sequence[Plot] = ()
    previous: str | None = None
    changes: Sequence[QuantityChange] = ()


@dataclass(frozen=True)
class Previous:
    """Content of an earlier `calibration.json`."""

    kind: str
    calibration_id: str
    date: str
    serials: Mapping[str, str]
    quantities: tuple[Quantity, ...]


def changes_between(old: Sequence[Quantity], new: Sequence[Quantity]) -> tuple[QuantityChange, ...]:
    """Compare what both calibrations hold, by `where` and `what`, in the order of `new`.

    A sigma that one side does not know counts as none of that side; with neither known nothing is
    called significant. The limit is that of a family of as many tests (two-sided, Bonferroni).
    """
    before = {(q.where, q.what): q for q in old}
    pairs = [
        (before[q.where, q.what], q)
        for q in new
        if (q.where, q.what) in before and before[q.where, q.what].unit == q.unit
    ]
    limit = -float(ndtri(FAMILY_ALPHA / 2.0 / max(len(pairs), 1)))
    return tuple(
        QuantityChange(
            b.where, b.what, b.unit, a.value, b.value, _combined_sigma(a.sigma, b.sigma), limit
        )
        for a, b in pairs
    )


def _combined_sigma(a: float | None, b: float | None) -> float | None:
    known = [s for s in (a, b) if s is not None and math.isfinite(s)]
    return math.hypot(*known) if known else None


def serial_warnings(previous: Previous, serials: Mapping[str, str]) -> list[str]:
    """A message for every part whose serial number changed."""
    return [
        f"{name} is now {serial!r}, the calibration {previous.calibration_id} was of "
        f"{previous.serials[name]!r}: differences are between two parts, not a change of one"
        for name, serial in serials.items()
        if name in previous.serials and previous.serials[name] != serial
    ]


def calibration_json(report: CalibrationReport) -> dict[str, Any]:
    """The content of `calibration.json`, and what --json prints."""
    return {
        "format": CALIBRATION_FORMAT,
        "kind": report.kind,
        "calibration_id": report.calibration_id,
        "date": report.date,
        "facts": dict(report.facts),
        "serials": dict(report.serials),
        "quantities": [
            {
                "where": q.where,
                "what": q.what,
                "unit": q.unit,
                "value": q.value,
                "sigma": q.sigma,
            }
            for q in report.quantities
        ],
        "figures": dict(report.figures),
        "verdicts": list(report.verdicts),
        "warnings": list(report.warnings),
        "previous": report.previous,
        "changes": [
            {
                "where": c.where,
                "what": c.what,
                "unit": c.unit,
                "old": c.old,
                "new": c.new,
                "sigma": c.sigma,
                "t": c.t,
                "significant": c.significant,
            }
            for c in report.changes
        ],
    }


def report_html(report: CalibrationReport) -> str:
    """The report as one page that needs nothing else."""
    loader = jinja2.FileSystemLoader(Path(__file__).parents[1] / "templates")
    environment = jinja2.Environment(
        loader=loader,
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        finalize=visible_value,
    )
    environment.filters["cell"] = _cell
    # The template takes drawings as they are: they are our own and escape what comes from files.
    return environment.get_template("calibration.html").render(r=report)


def _cell(value: Cell) -> str:
    if value is None:
        return "\u2013"
    if isinstance(value, float):
        return f"{value:.6g}"
    return str(value)


def write_calibration(
    folder: Path, report: CalibrationReport, files: Mapping[str, bytes] | None = None
) -> Path:
    """Write a new calibration: `calibration.json`, `report.html` and `files` by relative name.

    Raises:
        CalibrationFolderError: the folder exists.
        OSError: the disk refused.
    """
    refuse_existing(folder)
    content = {
        "calibration.json": canonical_bytes(calibration_json(report)),
        "report.html": report_html(report).encode("utf-8"),
        **(files or {}),
    }
    with new_files(folder, last="calibration.json") as part:
        for name, data in content.items():
            make_directories((part / name).parent)
            create_file(part / name, [data])
        refuse_existing(folder)
    return folder


def refuse_existing(folder: Path) -> None:
    """Refuse an existing folder, before anything is computed.

    Raises:
        CalibrationFolderError: it exists.
    """
    if folder.exists():
        raise CalibrationFolderError(
            f"{folder} exists; a calibration is never overwritten: give another name with --out"
        )


@dataclass(frozen=True)
class CalibrationFolder:
    """Place of a new calibration: in `folder`, or in one named by its id in `parent`.

    `name` is what its id begins with; a digest of its content follows (`content_digest`).
    """

    name: str
    parent: Path
    folder: Path | None = None

    def of(self, calibration_id: str) -> Path:
        """The folder of the calibration of this id."""
        return self.folder or self.parent / calibration_id


def calibration_folder(
    out: Path | None, stem: str, date: str, *, next_to: Path
) -> CalibrationFolder:
    """Choose the folder of a new calibration, before anything is computed.

    Args:
        out: the requested folder; None takes one next to `next_to`, which the calibration is made
            from, named by `stem`, `date` and content.

    Raises:
        CalibrationFolderError: the requested folder exists, or nothing can be written there.
    """
    if out is not None:
        refuse_existing(out)
        return CalibrationFolder(out.name, out.parent, out)
    parent = next_to.resolve().parent
    if not os.access(parent, os.W_OK):
        raise CalibrationFolderError(
            f"{parent} cannot be written to; say with --out where the new calibration is to lie"
        )
    return CalibrationFolder(f"{stem}-{date}", parent)


def content_digest(files: Mapping[str, bytes]) -> str:
    """Distinguishes calibrations of the same name: eight hexadecimal digits of SHA-256."""
    digest = hashlib.sha256()
    for name in sorted(files):
        digest.update(f"{name} {len(files[name])}\n".encode())
        digest.update(files[name])
    return digest.hexdigest()[:8]


def with_content_id(
    report: CalibrationReport,
    files: Mapping[str, bytes],
    rig_file: Callable[[str], bytes] | None = None,
) -> tuple[CalibrationReport, dict[str, bytes]]:
    """A calibration with an id that no other content has, and its files.

    Args:
        report: its id is what the new one begins with.
        rig_file: makes its `rig.toml`, where it has one, by its id.
    """
    name = report.calibration_id
    content = {**files, "calibration.json": canonical_bytes(calibration_json(report))}
    if rig_file is not None:
        content["rig.toml"] = rig_file(name)
    identified_report = replace(report, calibration_id=f"{name}-{content_digest(content)}")
    own = {} if rig_file is None else {"rig.toml": rig_file(identified_report.calibration_id)}
    return identified_report, {**files, **own}


def read_previous(path: Path, *, kind: str) -> Previous:
    """Read an earlier calibration of the same kind: its folder, or its `calibration.json`.

    Raises:
        CalibrationFolderError: missing, damaged, or of another kind.
    """
    file = path / "calibration.json" if path.is_dir() else path
    try:
        if file.stat().st_size > CALIBRATION_MAX_BYTES:
            raise CalibrationFolderError(f"{file}: too large to be a calibration.json")
        content = json.loads(file.read_bytes())
        previous = Previous(
            kind=str(content["kind"]),
            calibration_id=str(content["calibration_id"]),
            date=str(content["date"]),
            serials={str(k): str(v) for k, v in content["serials"].items()},
            quantities=tuple(_quantity(q) for q in content["quantities"]),
        )
    except OSError as error:
        raise CalibrationFolderError(
            f"{file}: cannot be read ({error.strerror}); give the folder of a calibration"
        ) from error
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise CalibrationFolderError(
            f"{file}: not a calibration.json of this program ({error})"
        ) from error
    if previous.kind != kind:
        raise CalibrationFolderError(
            f"{file} is a {previous.kind!r} calibration; compare with one made by "
            f"`syntopic calibrate {kind}`"
        )
    return previous


def _quantity(content: Mapping[str, Any]) -> Quantity:
    sigma = content["sigma"]
    return Quantity(
        where=str(content["where"]),
        what=str(content["what"]),
        unit=str(content["unit"]),
        value=float(content["value"]),
        sigma=None if sigma is None else float(sigma),
    )
