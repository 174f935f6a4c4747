"""The record of fuzzing: a parser is done after enough CPU time without a new edge."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.robustness.fuzz import progress
from tests.robustness.fuzz.progress import Piece, Progress, begun, piece_of, read, until_quiet

OUTPUT = f"""{begun(4.5)}
INFO: seed corpus: files: 12
#13	INITED cov: 210 ft: 300 corp: 9/1Kb exec/s: 0 rss: 60Mb
#900	NEW    cov: 214 ft: 310 corp: 10/1Kb lim: 100 exec/s: 450 rss: 61Mb
#4096	DONE   cov: 214 ft: 310 corp: 10/1Kb lim: 100 exec/s: 450 rss: 61Mb
"""


def test_the_output_of_the_fuzzer_is_read_and_its_start_is_not_counted() -> None:
    assert piece_of(OUTPUT, 34.5, is_well=True) == Piece(30.0, 4096, 214)
    assert piece_of("killed at once", 3.0, is_well=False) == Piece(0.0, 0, 0, is_well=False)


def test_a_new_edge_a_crash_and_other_code_restart_the_quiet_time() -> None:
    first = Progress().after(Piece(60.0, 10, 200), "a")
    assert (first.quiet_cpu_s, first.edges) == (0.0, 200)
    quiet = first.after(Piece(60.0, 10, 200), "a").after(Piece(50.0, 10, 190), "a")
    assert (quiet.quiet_cpu_s, quiet.cpu_s, quiet.edges, quiet.executions) == (110, 170, 200, 30)
    assert quiet.after(Piece(60.0, 10, 201), "a").quiet_cpu_s == 0.0
    crashed = quiet.after(Piece(60.0, 10, 200, is_well=False), "a")
    assert (crashed.quiet_cpu_s, crashed.failures) == (0.0, 1)
    changed = quiet.after(Piece(60.0, 10, 150), "b")
    assert (changed.quiet_cpu_s, changed.edges) == (0.0, 150)


def test_parsers_are_gone_round_until_quiet_and_the_record_is_gone_on_with(tmp_path: Path) -> None:
    run: list[str] = []

    def piece(name: str) -> Piece:
        run.append(name)
        if len(run) == 4:
            raise KeyboardInterrupt  # ended at any time
        return Piece(60.0, 10, 100)

    with pytest.raises(KeyboardInterrupt):
        until_quiet(("a", "b"), tmp_path, 120.0, piece)
    assert run == ["a", "b", "a", "b"]
    assert {name: one.quiet_cpu_s for name, one in read(tmp_path).items()} == {"a": 60.0, "b": 0.0}
    assert until_quiet(("a", "b"), tmp_path, 120.0, piece) == 0
    assert run[4:] == ["b", "a", "b"], "the one with least CPU time first; a is done after one more"
    assert {one.quiet_cpu_s for one in read(tmp_path).values()} == {120.0}
    run.clear()
    assert until_quiet(("a", "b"), tmp_path, 120.0, piece) == 0 and run == []


def test_other_code_is_fuzzed_again_and_a_crash_ends_that_parser_only(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(progress, "code_digest", lambda: "a")
    assert until_quiet(("a",), tmp_path, 60.0, lambda _: Piece(60.0, 1, 9)) == 0
    monkeypatch.setattr(progress, "code_digest", lambda: "b")
    run: list[str] = []

    def piece(name: str) -> Piece:
        run.append(name)
        return Piece(60.0, 1, 9, is_well=name != "a")

    assert until_quiet(("a", "b"), tmp_path, 60.0, piece) == 1
    assert run == ["b", "a", "b"]


def test_without_a_folder_for_the_record_nothing_is_begun(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from tests.robustness.fuzz.__main__ import main

    monkeypatch.setattr("sys.argv", ["fuzz", "rig", "--quiet-minutes", "1"])
    with pytest.raises(SystemExit):
        main()
    assert "needs --work FOLDER" in capsys.readouterr().err
