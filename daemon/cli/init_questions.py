"""Questions of `syntopic init`: at most eight, each asked again until its answer can be right."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import TypeVar

from daemon.initialization.answers import (
    ANGLE_DEG,
    DISTANCE_MM,
    INTERVAL_S,
    AnswerError,
    Arrangement,
    arrangement_problem,
    focal_length_mm,
    in_range,
    lengths,
    pixel_size_um,
)
from daemon.terminal.console import Console

T = TypeVar("T")
ORDERS = {
    Arrangement.SIDE_BY_SIDE: "from left to right",
    Arrangement.FORE_AFT: "from front to back",
    Arrangement.NADIR_OBLIQUE: "nadir, front, right, back, left",
}


class Questions:
    """Asks on a terminal.

    Args:
        console: prints questions and refusals.
    """

    def __init__(self, console: Console) -> None:
        self._console = console
        self.asked = 0

    def ask(self, question: str, default: str, read: Callable[[str], T]) -> T:
        """The answer as `read` understands it; asked again after an `AnswerError`.

        Raises:
            KeyboardInterrupt: Ctrl-C or the end of the input.
        """
        self.asked += 1
        hint = f" [{default}]" if default else ""
        while True:
            self._console.print(f"{self.asked}. {question}{hint}: ", end="", highlight=False)
            line = sys.stdin.readline()
            if not line:
                raise KeyboardInterrupt
            try:
                return read(line.strip() or default)
            except AnswerError as error:
                self._console.print(f"   {error}.", style="red", soft_wrap=True, highlight=False)

    def refuse(self, sentence: str, count: int) -> None:
        """Print why the last `count` answers cannot be right together; they are asked for again."""
        self._console.print(f"   {sentence}.", style="red", soft_wrap=True, highlight=False)
        self.asked -= count

    def arrangement(self, count: int) -> Arrangement:
        choices = [one for one in Arrangement if arrangement_problem(one, count) is None]
        listed = ", ".join(one.value for one in choices)
        return self.ask(
            f"How do the heads stand: {listed}", choices[0].value, lambda t: arrangement(t, count)
        )

    def order(self, count: int, how: Arrangement) -> list[int]:
        """Indices of the chosen heads in their order."""
        default = " ".join(str(number) for number in range(1, count + 1))
        return self.ask(
            f"Numbers of the heads, {ORDERS[how]}", default, lambda t: chosen_heads(t, count, how)
        )

    def focal_lengths(self, count: int) -> tuple[float, ...]:
        each = ", one or one for each head" if count > 1 else ""
        return self.ask(f"Focal length in mm{each}", "", lambda t: focal_lengths(t, count))

    def pixel_sizes(self, count: int) -> tuple[float, ...]:
        each = ", one or one for each head" if count > 1 else ""
        return self.ask(f"Pixel size in um{each}", "", lambda t: pixel_sizes(t, count))

    def angle(self, default: float) -> float:
        return self.ask(
            "Angle between neighbouring axes in degrees", f"{default:g}", lambda t: angle_deg(t)
        )

    def distance(self, default: float) -> float:
        return self.ask(
            "Distance between neighbouring lenses in mm", f"{default:g}", lambda t: distance_mm(t)
        )

    def interval(self, default: float) -> float:
        return self.ask("Time between two exposures in s", f"{default:g}", lambda t: interval_s(t))

    def agrees(self, question: str) -> bool:
        return self.ask(question, "yes", _yes_or_no)


def arrangement(text: str, count: int) -> Arrangement:
    """An arrangement by its name or the beginning of it. AnswerError: there is none such."""
    found = [one for one in Arrangement if text and one.value.startswith(text.lower())]
    if len(found) != 1:
        listed = ", ".join(one.value for one in Arrangement)
        raise AnswerError(f"{text!r} is no arrangement; one of {listed}")
    problem = arrangement_problem(found[0], count)
    if problem:
        raise AnswerError(problem)
    return found[0]


def chosen_heads(text: str, count: int, how: Arrangement) -> list[int]:
    """Indices of heads by their numbers in the table. AnswerError: a number that is none."""
    try:
        numbers = [int(word) for word in text.replace(",", " ").split()]
    except ValueError:
        raise AnswerError(f"{text!r} is no list of numbers such as 1 2") from None
    if any(not 1 <= number <= count for number in numbers):
        raise AnswerError(f"the heads have the numbers 1 to {count}")
    if len(set(numbers)) < len(numbers):
        raise AnswerError("a head is given twice; give each once")
    problem = arrangement_problem(how, len(numbers))
    if problem:
        raise AnswerError(problem)
    return [number - 1 for number in numbers]


def focal_lengths(text: str, count: int | None) -> tuple[float, ...]:
    """Focal lengths of all heads in mm. AnswerError: one that cannot be."""
    return tuple(focal_length_mm(value) for value in lengths(text, "mm", count))


def pixel_sizes(text: str, count: int | None) -> tuple[float, ...]:
    """Pixel sizes of all heads in um. AnswerError: one that cannot be."""
    return tuple(pixel_size_um(value) for value in lengths(text, "um", count))


def angle_deg(text: str) -> float:
    """An angle between axes."""
    return in_range(_number(text, "deg"), ANGLE_DEG, "the angle between axes", "degrees")


def distance_mm(text: str) -> float:
    """A distance between lenses."""
    return in_range(lengths(text, "mm", 1)[0], DISTANCE_MM, "the distance between lenses", "mm")


def interval_s(text: str) -> float:
    """A time between exposures."""
    return in_range(_number(text, "s"), INTERVAL_S, "the time between exposures", "s")


def _number(text: str, unit: str) -> float:
    try:
        return float(text.removesuffix(unit).strip())
    except ValueError:
        raise AnswerError(f"{text!r} is no number; write a value such as 2 or 2.5") from None


def _yes_or_no(text: str) -> bool:
    word = text.lower()
    if word not in ("y", "yes", "n", "no"):
        raise AnswerError("answer yes or no")
    return word.startswith("y")
