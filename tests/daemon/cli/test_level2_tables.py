"""The output of `syntopic process` states why an exposure is not good."""

from __future__ import annotations

import io

from daemon.cli.level2_tables import print_reports
from daemon.terminal.console import Console


def test_reasons_of_exposures_that_are_not_good_follow_the_table() -> None:
    findings = [
        {"verdict": "good", "sentence": "Simulated hardware: not a survey."},
        {"verdict": "usable", "sentence": "Head SU10 sent no image."},
    ]
    report = {
        "exposure": 7,
        "figures": {"method": "free"},
        "findings": findings,
        "verdict": "usable",
        "duration_s": 1.0,
    }
    output = io.StringIO()
    print_reports(Console(file=output, width=100), "Level-2", [report])
    assert "Exposure 7: Head SU10 sent no image." in output.getvalue()
    assert "Simulated" not in output.getvalue()
    assert "0.000" not in output.getvalue(), "an unknown sigma0 is not a perfect one"
