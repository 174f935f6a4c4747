"""What `syntopic init` prints: the rig, the check, what is provisional, and what to do next."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from daemon.cli.check import COLOURS
from daemon.cli.init_answers import optics
from daemon.initialization.answers import Answers, field_of_view_deg
from daemon.initialization.provisional import Assumption
from daemon.terminal.console import Console, light_table

if TYPE_CHECKING:
    from daemon.onboard.preflight.check_results import CheckResult
    from drivers.detection.port_search import DetectionResult


def print_rig(console: Console, answers: Answers) -> None:
    from daemon.initialization.mounting import mounting_of

    mounting = mounting_of(answers)
    figures = ("f mm", "pixel um", "view deg", "forward mm", "right mm")
    table = light_table(f"Rig {answers.name}", ("head", "at", "omega phi kappa"), figures)
    for one, place, focal_mm, pixel_um in zip(
        answers.heads, mounting.heads, answers.focal_lengths_mm, answers.pixel_sizes_um, strict=True
    ):
        table.add_row(
            place.name,
            one.place,
            " ".join(f"{angle:g}" for angle in place.rotation_deg),
            f"{focal_mm:g}",
            f"{pixel_um:g}",
            f"{field_of_view_deg(one, focal_mm, pixel_um):.1f}",
            f"{place.position_mm[0]:g}",
            f"{place.position_mm[1]:g}",
        )
    console.print(table)


def is_failed(results: Sequence[CheckResult]) -> bool:
    """Whether an item of the check fails; one that is waiting does not, nor a strobe without
    cable."""
    return any(one.outcome.value == "fail" and not is_absent_mark(one) for one in results)


def is_absent_mark(one: CheckResult) -> bool:
    """Whether a receiver gave no event mark: the rig flies with the time of its triggers."""
    is_mark = one.kind == "stream" and one.name.startswith("event mark ")
    return is_mark and one.outcome.value == "fail"


def print_end(
    console: Console,
    folder: Path,
    written: Sequence[Path],
    provisional: Sequence[Assumption],
    results: Sequence[CheckResult],
) -> None:
    config = folder / "service.toml"
    _print_results(console, results)
    table = light_table("Provisional", ("value", "taken as", "until"), ())
    for one in provisional:
        table.add_row(*one)
    console.print(table)
    console.print(f"Written: {', '.join(str(path) for path in written)}", soft_wrap=True)
    if is_failed(results):
        console.print(
            f"Not ready; do as the sentences in red say, then: syntopic check {config} --fire",
            style="bold red",
            soft_wrap=True,
        )
        return
    console.print(f"Next: syntopic run {config}", style="bold", soft_wrap=True)


def _print_results(console: Console, results: Sequence[CheckResult]) -> None:
    """The number of items that pass, and every other with its sentence."""
    if not results:
        return
    fine = [one for one in results if one.outcome.value == "pass"]
    console.print(f"Check: {len(fine)} of {len(results)} items pass", style="bold")
    for one in results:
        outcome = one.outcome.value
        is_caution = one.sentence.startswith("caution")
        if outcome == "pass" and not is_caution:
            continue
        label = ": ".join(filter(None, (one.kind, one.name, one.sentence)))
        if is_absent_mark(one):
            label += ". Until then exposures have the time of their trigger and MARK_MISSING"
            outcome, is_caution = "missing", True
        style = "yellow" if is_caution else COLOURS[outcome]
        console.print(f"  {outcome}  {label}", style=style, soft_wrap=True)


def initialization_json(
    answers: Answers,
    found: Sequence[DetectionResult],
    written: Sequence[Path],
    provisional: Sequence[Assumption],
    results: Sequence[CheckResult],
    seconds: float,
) -> dict[str, Any]:
    from daemon.cli.find_ports import result_json
    from daemon.initialization.rig_text import sensor_names
    from daemon.onboard.preflight.check_results import worst_outcome

    judged = [one for one in results if not is_absent_mark(one)]
    return {
        "rig": answers.name,
        "arrangement": answers.arrangement.value,
        "heads": [
            {
                "sensor": sensor,
                "driver": one.driver,
                "at": one.place,
                "model": one.model,
                "serial": one.serial,
                "width_px": one.width_px,
                "height_px": one.height_px,
                "pixel_format": one.pixel_format,
                "f_mm": focal_mm,
                "pitch_um": pixel_um,
            }
            for sensor, one, focal_mm, pixel_um in zip(
                sensor_names(answers), *optics(answers), strict=True
            )
        ],
        "ports": [result_json(one) for one in found],
        "written": [str(path) for path in written],
        "provisional": [one._asdict() for one in provisional],
        "outcome": worst_outcome(judged).value if results else "not tried",
        "findings": [result.as_json() for result in results],
        "seconds": round(seconds, 2),
    }
