"""How far the fuzzing of each parser went: CPU seconds and edges, recorded as JSON piece by piece.

An edge is libFuzzer's "cov": a branch of instrumented Python code. A change of the code restarts
the time without new edges, since its edges differ.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from daemon.mission.store import durable

RECORD = "progress.json"
ROOT = Path(__file__).parents[3]
CODE = ("daemon", "drivers", "processing", "tests/robustness/fuzz/targets.py")
_LINE = re.compile(r"^#(\d+)\s.*\bcov: (\d+)", re.MULTILINE)
_BEGUN = re.compile(r"^begun after ([\d.]+) s of CPU$", re.MULTILINE)


@dataclass(frozen=True)
class Piece:
    """One run of the fuzzer.

    `cpu_s` is without the start of the process, `edges` counts those of all inputs kept so far.
    """

    cpu_s: float
    executions: int
    edges: int
    is_well: bool = True


@dataclass(frozen=True)
class Progress:
    """All pieces of a parser. `quiet_cpu_s` is since the end of the last one with a new edge."""

    cpu_s: float = 0.0
    quiet_cpu_s: float = 0.0
    executions: int = 0
    edges: int = 0
    failures: int = 0
    code: str = ""

    def after(self, piece: Piece, code: str) -> Progress:
        """With one more piece, of this code."""
        is_same = code == self.code
        is_quiet = is_same and piece.edges <= self.edges and piece.is_well
        return Progress(
            cpu_s=round(self.cpu_s + piece.cpu_s, 1),
            quiet_cpu_s=round(self.quiet_cpu_s + piece.cpu_s, 1) if is_quiet else 0.0,
            executions=self.executions + piece.executions,
            edges=max(piece.edges, self.edges if is_same else 0),
            failures=self.failures + (not piece.is_well),
            code=code,
        )


def begun(cpu_s: float) -> str:
    """The line in which the fuzzer reports its start."""
    return f"begun after {cpu_s:.3f} s of CPU"


def piece_of(output: str, cpu_s: float, *, is_well: bool) -> Piece:
    """The fuzzer's report on a run that took `cpu_s` in all."""
    counted = [(int(number), int(edges)) for number, edges in _LINE.findall(output)]
    start = _BEGUN.search(output)
    return Piece(
        cpu_s=max(0.0, cpu_s - float(start[1])) if start else 0.0,
        executions=max((number for number, _ in counted), default=0),
        edges=max((edges for _, edges in counted), default=0),
        is_well=is_well,
    )


def until_quiet(
    names: Sequence[str], work: Path, quiet_s: float, run: Callable[[str], Piece]
) -> int:
    """Go round the parsers, those with least CPU time first, until all are quiet or have failed.

    Args:
        names: of the parsers.
        work: folder of the record.
        quiet_s: CPU seconds without a new edge after which a parser is done.
        run: fuzzes one for a while.

    Returns:
        The exit status: 0, or 1 where one failed.
    """
    work.mkdir(parents=True, exist_ok=True)
    code, known = code_digest(), read(work)
    # What was quiet in other code is not in this one.
    known = {
        name: found if found.code == code else replace(found, quiet_cpu_s=0.0)
        for name, found in known.items()
    }
    failed: set[str] = set()

    def left() -> list[str]:
        return [
            name
            for name in names
            if name not in failed and known.get(name, Progress()).quiet_cpu_s < quiet_s
        ]

    while waiting := sorted(left(), key=lambda name: known.get(name, Progress()).cpu_s):
        for name in waiting:
            piece = run(name)
            known[name] = known.get(name, Progress()).after(piece, code)
            if not piece.is_well or not piece.cpu_s:
                failed.add(name)
            write(work, known)
            state = known[name]
            print(f"{name}: {state.edges} edges, quiet for {state.quiet_cpu_s:.0f} s", flush=True)
    print(f"{len(names) - len(failed)} of {len(names)} without a crash", *sorted(failed))
    return 1 if failed else 0


def read(work: Path) -> dict[str, Progress]:
    """The record of a folder; none before the first piece."""
    path = work / RECORD
    content = json.loads(path.read_text("utf-8")) if path.exists() else {}
    return {name: Progress(**found) for name, found in content.items()}


def write(work: Path, known: Mapping[str, Progress]) -> None:
    """Replace the record as a whole, so that it may be ended at any time."""
    content = {name: asdict(found) for name, found in sorted(known.items())}
    durable.replace_file(work / RECORD, json.dumps(content, indent=1).encode() + b"\n")


def code_digest() -> str:
    """Changes with the code that is fuzzed."""
    digest = hashlib.sha256()
    for place in CODE:
        path = ROOT / place
        for one in [path] if path.is_file() else sorted(path.rglob("*.py")):
            digest.update(one.read_bytes())
    return digest.hexdigest()[:16]
