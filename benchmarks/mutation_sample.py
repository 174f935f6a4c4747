"""`python -m benchmarks.mutation_sample`: do the nearest tests detect a changed decision?

Draws mutations by seed from the modules that compute results, applies each to a copy of the tree,
and runs the tests nearest to the module: those that import it, the one of its name first. A
mutation that they do not detect is listed. Names in `EQUIVALENT` are changes that alter no outcome.

`--only` and `--skip` run a part of the same draw. With `--record` a stopped run
is resumed.
"""

from __future__ import annotations

import argparse
import ast
import hashlib
import itertools
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from benchmarks import equivalent_mutations
from benchmarks.mutations import Mutation, mutations

ROOT = Path(__file__).parent.parent
COPIED = ("daemon", "drivers", "processing", "sim_hw", "tests", "benchmarks", "docs", "systemd")
DECIDING = (
    "daemon/onboard/flight/*.py",
    "daemon/onboard/timing/*.py",
    "daemon/mission/**/*.py",
    "daemon/planning/*.py",
    "drivers/**/decoder.py",
    "drivers/**/framing.py",
    "drivers/receivers/nmea/sentences.py",
    "drivers/receivers/gpsd/reports.py",
    "drivers/receivers/message_framer.py",
    "drivers/timescales/gps_time.py",
    "processing/mosaic/*.py",
    "processing/bundle/*.py",
    "processing/quality/*.py",
    "processing/geometry/*.py",
)
NOT_DECIDING = ("drawing.py", "findings.py")
"""Pictures and sentences: no decision rests on them."""
MAX_TEST_FILES = 8
"""So many of the nearest test files run, nearest first."""
WATCHED = "processing/"
"""Of these modules only test files count that execute the changed line; others run in threads."""
SLOWEST_S = 600
"""So long may one test file take without a mutation."""
TIME_FACTOR = 3
MIN_TIMEOUT_S = 20.0
"""A mutation has this many times what the file takes without it, and no less than so long."""
DETECTION_GOAL = 0.9
EQUIVALENT: dict[str, str] = {
    "daemon/mission/catalog/catalog.py: elif version < SCHEMA_VERSION:: < -> <=": (
        "the same version was handled two branches above"
    ),
    'daemon/mission/catalog/catalog.py: code = getattr(error, "sqlite_errorcode", 0) & 0xFF: 0 -> 1': (
        "neither 0 nor 1 (SQLITE_ERROR) is busy or locked"
    ),
    "daemon/onboard/flight/ledger.py: self._in_storage[StorageState.VOLATILE] += 1: += -> -=": (
        "the number of volatile exposures is never read"
    ),
    "daemon/onboard/flight/ledger.py: self._in_storage[StorageState.VOLATILE] += 1: 1 -> 2": (
        "the number of volatile exposures is never read"
    ),
    "daemon/onboard/timing/gps_clock.py: COARSE_SIGMA_NS: Final = round((ARRIVAL_MAX_NS - ARRIVAL_MIN_NS)"
    " / math.sqrt(12)): - -> +": "ARRIVAL_MIN_NS is 0",
    "daemon/onboard/timing/gps_clock.py: second = math.ceil((max(offsets_ns) + ARRIVAL_MIN_NS) / SECOND_NS): "
    "+ -> -": "ARRIVAL_MIN_NS is 0",
    "daemon/onboard/timing/gps_clock.py: (r, min(1.0, limit * s / max(abs(r - middle), 1e-9)) / s**2): "
    "1e-9 -> 1.5000000000000002e-09": (
        "limit * s is 4 at least, so that a residual below 4 ns counts in full either way"
    ),
    "drivers/timescales/gps_time.py: leap = (difference + SECOND_NS // 2) // SECOND_NS: 2 -> 3": (
        "within the slack of 1 ms both round alike, beyond it both give None"
    ),
    "drivers/receivers/septentrio/decoder.py: count=self._counts[channel] % (1 << COUNT_BITS),: 1 -> 2": (
        "no flight has 2**32 marks"
    ),
    "drivers/timescales/gps_time.py: offset = (itow_ms * 1_000_000 - near_gps_ns + WEEK_NS // 2) % WEEK_NS"
    " - WEEK_NS // 2: + -> -": "modulo a week, half a week more is half a week less",
    "drivers/timescales/gps_time.py: difference = (itow_ms * 1_000_000 - utc + WEEK_NS // 2) % WEEK_NS"
    " - WEEK_NS // 2: + -> -": "modulo a week, half a week more is half a week less",
    "daemon/mission/transfer/transfer_removal.py: source.replace(MOVED_FILE, json.dumps(mark, indent=1)"
    '.encode("utf-8", "replace") + b"\\n"): 1 -> 2': "layout of a file that is read as JSON",
    "daemon/mission/mirror/resync.py: repetition = 1: 1 -> 2": "any free name will do",
    "drivers/receivers/ublox/framing.py: return end - at if end <= len(buffer) else 0: - -> +": (
        "only whether it is zero is read"
    ),
    "daemon/mission/mirror/resync.py: closing(sqlite3.connect(address, uri=True)) as reading,: "
    "True -> False": (
        "SQLite built with SQLITE_USE_URI, as Debian's is, reads addresses in any case"
    ),
    "daemon/onboard/timing/matching.py: since_latch_ns = abs((frame.device_ns or 0) - "
    "(frame.device_clock_ns or 0)): 0 -> 1": (
        "both are there where a start is known; one that is 0 counts as 1 ns of drift time"
    ),
    "daemon/onboard/timing/clock_model.py: return statistics.median(ratios) / 0.6745 "
    "if len(ratios) >= SCATTER_PAIRS_MIN else 1.0: 1.0 -> 1.5": (
        "a factor up to SCATTER_LARGE counts as 1 where it is used"
    ),
    "drivers/receivers/mavlink/decoder.py: if angle < 1e-9:: 1e-9 -> 1.5000000000000002e-09": (
        "the least angle above 0 that the arc cosine gives is 1.5e-8"
    ),
} | equivalent_mutations.EQUIVALENT
"""Mutation as printed, without its line -> why no outcome differs."""


@dataclass(frozen=True)
class Outcome:
    """What became of one mutation."""

    module: str
    line: int
    column: int
    before: str
    after: str
    source: str
    outcome: str
    tests: int
    seconds: float

    @property
    def name(self) -> str:
        return f"{self.module}: {self.source}: {self.before} -> {self.after}"


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.mutation_sample", description=__doc__
    )
    parser.add_argument("--count", type=int, default=300, help="mutations to draw (default: 300)")
    parser.add_argument("--seed", type=int, default=1, help="seed of the draw (default: 1)")
    parser.add_argument("--only", default="", help="only modules whose path contains this")
    parser.add_argument("--skip", default="", help="leave out modules whose path contains this")
    parser.add_argument("--record", type=Path, help="append outcomes as lines of JSON, and resume")
    parser.add_argument("--json", action="store_true", help="print one JSON object at the end")
    options = parser.parse_args()
    drawn = [
        (module, mutation)
        for module, mutation in draw(options.count, options.seed)
        if options.only in module and not (options.skip and options.skip in module)
    ]
    known = _recorded(options.record)
    outcomes = []
    with tempfile.TemporaryDirectory(prefix="syntopic-mutations-") as folder:
        tests = NearestTests(Path(folder))
        for number, (module, mutation) in enumerate(drawn, 1):
            source = (ROOT / module).read_text()
            outcome = known.get(_key(module, mutation, source))
            if outcome is None:
                outcome = _try(tests, module, mutation, source)
                if options.record:
                    with options.record.open("a") as record:
                        record.write(json.dumps(asdict(outcome)) + "\n")
            if outcome.outcome == "survived" and outcome.name in EQUIVALENT:
                outcome = replace(outcome, outcome="equivalent")
            outcomes.append(outcome)
            if not options.json:
                print(f"{number}/{len(drawn)} {outcome.outcome:9} {outcome.name}", flush=True)
    _print(outcomes, options.seed, as_json=options.json)


def draw(count: int, seed: int) -> list[tuple[str, Mutation]]:
    """Draw mutations, every place of every deciding module with the same probability.

    Each place has a rank that depends on the seed, its module and its text alone, and those of the
    lowest ranks are drawn: a change of one module changes nothing in what is drawn of others.
    """
    modules = sorted(
        str(path.relative_to(ROOT))
        for pattern in DECIDING
        for path in ROOT.glob(pattern)
        if path.name not in NOT_DECIDING
    )
    ranked = []
    for module in modules:
        source = (ROOT / module).read_text()
        repeated: Counter[str] = Counter()
        for place in mutations(source):
            name = "\0".join((str(seed), module, _line(source, place), place.before, place.after))
            rank = hashlib.sha256(f"{name}\0{repeated[name]}".encode()).digest()
            repeated[name] += 1
            ranked.append((rank, module, place))
    ranked.sort(key=lambda each: each[0])
    sources = {module: (ROOT / module).read_text() for module in modules}
    drawn = ((m, place) for _, m, place in ranked if place.parses(sources[m]))
    return list(itertools.islice(drawn, count))


def nearest_tests(module: str, importers: dict[str, set[str]]) -> list[str]:
    """Choose the test files nearest to a module: of its name, of its folder, then its importers."""
    dotted = module.removesuffix(".py").replace("/", ".")
    folder = Path("tests") / Path(module).parent
    direct = importers.get(dotted, set())

    def distance(test: str) -> tuple[bool, bool, bool, str]:
        named = Path(module).stem in Path(test).stem
        return (not named, test not in direct, Path(test).parent != folder, test)

    of_folder = {str(p.relative_to(ROOT)) for p in (ROOT / folder).glob("test_*.py")}
    driver = Path(module).parent.name if module.startswith("drivers/") else None
    of_driver = {
        str(p.relative_to(ROOT))
        for p in ROOT.glob("tests/drivers/test_*.py")
        if driver and driver in p.stem
    }
    candidates = {t for t in direct | of_folder | of_driver if "/system/" not in t}
    return sorted(candidates, key=distance)


def _importers() -> dict[str, set[str]]:
    """Which test files import which module."""
    found: dict[str, set[str]] = {}
    for path in (ROOT / "tests").rglob("test_*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            names: Iterable[str] = ()
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom) and node.module:
                names = [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
            for name in names:
                found.setdefault(name, set()).add(str(path.relative_to(ROOT)))
    return found


def _copy_tree(folder: Path) -> Path:
    tree = folder / "tree"
    tree.mkdir(parents=True)
    for name in COPIED:
        shutil.copytree(ROOT / name, tree / name)
    for name in ("pyproject.toml", "README.md", "CHANGELOG.md", "Makefile", "requirements.lock"):
        shutil.copy2(ROOT / name, tree / name)
    shared = ROOT.parent / "shared"
    if shared.exists():
        (folder / "shared").symlink_to(shared.resolve())
    return tree


def _try(tests: NearestTests, module: str, mutation: Mutation, source: str) -> Outcome:
    path = tests.tree / module
    started = time.monotonic()
    try:
        path.write_text(mutation.apply(source))
        outcome, ran = tests.run_tests(module, _statement(source, mutation.line))
    finally:
        path.write_text(source)
    seconds = round(time.monotonic() - started, 1)
    return Outcome(*_key(module, mutation, source), outcome, ran, seconds)


@dataclass(frozen=True)
class PlainRun:
    """A test file without a mutation: how long it takes, which lines it executes where watched."""

    seconds: float
    executed: dict[str, list[int]]


class NearestTests:
    """The test files nearest to each module, run in a copy of the tree that mutations change.

    Another copy stays unchanged; it shows which files pass without a mutation, how fast, and which
    of them execute a line of `processing` at all.
    """

    def __init__(self, folder: Path) -> None:
        self.tree, self._unchanged = _copy_tree(folder / "a"), _copy_tree(folder / "b")
        self._importers = _importers()
        self._plain: dict[str, PlainRun | None] = {}

    def run_tests(self, module: str, lines: range) -> tuple[str, int]:
        """Run test files on the changed tree until one of them fails.

        Args:
            module: what was changed.
            lines: of the statement that was changed.

        Returns:
            The outcome, and how many test files it took.
        """
        ran = 0
        for test in nearest_tests(module, self._importers):
            plain = self._plain_run(test)
            if plain is None or (
                module.startswith(WATCHED) and not set(lines) & set(plain.executed.get(module, ()))
            ):
                continue
            ran += 1
            passed = _passes(self.tree, test, max(MIN_TIMEOUT_S, TIME_FACTOR * plain.seconds))
            if not passed:
                return "timeout" if passed is None else "detected", ran
            if ran == MAX_TEST_FILES:
                break
        return "survived" if ran else "no tests", ran

    def _plain_run(self, test: str) -> PlainRun | None:
        if test not in self._plain:
            found = self._unchanged / "executed-lines.json"
            started = time.monotonic()
            passed = _passes(self._unchanged, test, SLOWEST_S, executed_lines=found)
            seconds = time.monotonic() - started
            executed = json.loads(found.read_text()) if passed else {}
            self._plain[test] = PlainRun(seconds, executed) if passed else None
            if not passed:
                print(f"left out, fails without a mutation: {test}", file=sys.stderr, flush=True)
        return self._plain[test]


def _statement(source: str, line: int) -> range:
    """Lines of the smallest statement that a line belongs to."""
    spans = [
        range(node.lineno, node.end_lineno + 1)
        for node in ast.walk(ast.parse(source))
        if isinstance(node, ast.stmt) and node.end_lineno is not None
    ]
    return min((span for span in spans if line in span), key=len)


def _passes(
    tree: Path, test: str, limit_s: float, *, executed_lines: Path | None = None
) -> bool | None:
    """Whether a test file passes; None where it exceeds the time limit."""
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", test]
    environment = os.environ | {"PYTHONPATH": str(tree), "PYTHONDONTWRITEBYTECODE": "1"}
    if executed_lines is not None:
        command += ["-p", "benchmarks.executed_lines"]
        environment |= {"EXECUTED_LINES": str(executed_lines), "WATCHED": str(tree / WATCHED)}
    with subprocess.Popen(
        command,
        cwd=tree,
        env=environment,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    ) as ran:
        try:
            return ran.wait(limit_s) in (0, 5)
        except subprocess.TimeoutExpired:
            # Processes that the tests started end with them.
            os.killpg(ran.pid, signal.SIGKILL)
            return None


def _line(source: str, mutation: Mutation) -> str:
    return source.splitlines()[mutation.line - 1].strip()


_Key = tuple[str, int, int, str, str, str]


def _key(module: str, mutation: Mutation, source: str) -> _Key:
    """The first fields of an outcome: they name a mutation of this state of the module."""
    before = source.encode()[: mutation.start]
    column = mutation.start - (before.rfind(b"\n") + 1)
    line = _line(source, mutation)
    return module, mutation.line, column, mutation.before, mutation.after, line


def _recorded(record: Path | None) -> dict[_Key, Outcome]:
    """Outcomes of an earlier run."""
    lines = record.read_text().splitlines() if record and record.exists() else []
    outcomes = [Outcome(**json.loads(line)) for line in lines]
    return {(o.module, o.line, o.column, o.before, o.after, o.source): o for o in outcomes}


def _print(outcomes: Sequence[Outcome], seed: int, *, as_json: bool) -> None:
    counts = Counter(outcome.outcome for outcome in outcomes)
    evaluated = len(outcomes) - counts["equivalent"]
    detected = counts["detected"] + counts["timeout"]
    share = detected / evaluated if evaluated else 1.0
    unnoticed = [asdict(o) for o in outcomes if o.outcome in ("survived", "no tests")]
    if as_json:
        figures = {"seed": seed, "counts": counts, "detected_share": share, "survived": unnoticed}
        print(json.dumps(figures))
    else:
        print(f"seed {seed}: {dict(counts)}; detected {share:.1%} (goal {DETECTION_GOAL:.0%})")
    sys.exit(share < DETECTION_GOAL)


if __name__ == "__main__":
    main()
