"""Answers of `syntopic init`: those given by options, and questions for the others."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, TypeVar

import typer

from daemon.cli import init_questions as questions
from daemon.cli.init_questions import Questions
from daemon.initialization.answers import AnswerError, Answers, Arrangement, optics_problem

if TYPE_CHECKING:
    from drivers.cameras.head_description import HeadDescription

DEFAULT_ANGLES_DEG = {Arrangement.NADIR_OBLIQUE: 45.0}
DEFAULT_DISTANCE_MM = 100.0
DEFAULT_INTERVAL_S = 2.0

T = TypeVar("T")


class GivenAnswers:
    """Answers given by options, and questions for the others."""

    def __init__(
        self,
        *,
        arrangement: str | None,
        focal_length: str | None,
        pixel_size: str | None,
        angle: str | None,
        distance: str | None,
        interval: str | None,
        has_order: bool,
        asks: bool,
    ) -> None:
        self._arrangement = arrangement
        self._focal_length = focal_length
        self._pixel_size = pixel_size
        self._angle, self._distance, self._interval = angle, distance, interval
        self._has_order = has_order
        self._questions: Questions | None = None
        self.asks = asks

    def check_early(self) -> None:
        """Refuse what can be refused before any device is searched for."""
        missing = [
            option
            for option, value in (
                ("--focal-length", self._focal_length),
                ("--pixel-size", self._pixel_size),
            )
            if value is None
        ]
        if missing and not self.asks:
            raise typer.BadParameter(
                f"{' and '.join(missing)} {'are' if len(missing) > 1 else 'is'} needed where no "
                "question is asked"
            )
        if self._arrangement is not None and self._arrangement not in list(Arrangement):
            listed = ", ".join(one.value for one in Arrangement)
            raise typer.BadParameter(f"--arrangement is {self._arrangement!r}; one of {listed}")
        checks: tuple[tuple[str, str | None, Callable[[str], object]], ...] = (
            ("--focal-length", self._focal_length, lambda t: questions.focal_lengths(t, None)),
            ("--pixel-size", self._pixel_size, lambda t: questions.pixel_sizes(t, None)),
            ("--angle", self._angle, questions.angle_deg),
            ("--distance", self._distance, questions.distance_mm),
            ("--interval", self._interval, questions.interval_s),
        )
        for option, value, read in checks:
            if value is not None:
                read_option(option, value, read)

    def answers(self, name: str, heads: Sequence[HeadDescription], asked: Questions) -> Answers:
        """All answers; those not given by options are asked for, or have their defaults."""
        self._questions = asked if self.asks else None
        how = self._how(len(heads))
        heads = self._ordered(heads, how)
        count = len(heads)
        while True:
            answers = Answers(
                name,
                how,
                heads,
                self._lengths("--focal-length", count),
                self._lengths("--pixel-size", count),
            )
            problem = next(filter(None, map(optics_problem, *optics(answers))), None)
            if problem is None:
                break
            if self._questions is None or (self._focal_length and self._pixel_size):
                raise typer.BadParameter(problem)
            self._questions.refuse(problem, [self._focal_length, self._pixel_size].count(None))
        is_alone = count == 1
        angle = DEFAULT_ANGLES_DEG.get(how, 0.0)
        return replace(
            answers,
            angle_deg=0.0 if is_alone else self._number("--angle", self._angle, angle),
            distance_mm=(
                0.0 if is_alone else self._number("--distance", self._distance, DEFAULT_DISTANCE_MM)
            ),
            interval_s=self._number("--interval", self._interval, DEFAULT_INTERVAL_S),
        )

    def agree(self, question: str) -> bool:
        return self._questions is None or self._questions.agrees(question)

    def _how(self, count: int) -> Arrangement:
        if self._arrangement is not None:
            return read_option(
                "--arrangement", self._arrangement, lambda t: questions.arrangement(t, count)
            )
        if count == 1:
            return Arrangement.SINGLE
        if self._questions is None:
            raise typer.BadParameter(
                f"{count} heads were found; give --arrangement, or --head with the one to use"
            )
        return self._questions.arrangement(count)

    def _ordered(
        self, heads: Sequence[HeadDescription], how: Arrangement
    ) -> Sequence[HeadDescription]:
        if len(heads) == 1 or self._has_order or self._questions is None:
            return heads
        return [heads[index] for index in self._questions.order(len(heads), how)]

    def _lengths(self, option: str, count: int) -> tuple[float, ...]:
        is_focal = option == "--focal-length"
        value = self._focal_length if is_focal else self._pixel_size
        read = questions.focal_lengths if is_focal else questions.pixel_sizes
        if value is not None:
            return read_option(option, value, lambda t: read(t, count))
        assert self._questions is not None, "check_early refuses"
        ask = self._questions
        return ask.focal_lengths(count) if is_focal else ask.pixel_sizes(count)

    def _number(self, option: str, value: str | None, default: float) -> float:
        read, ask = {
            "--angle": (questions.angle_deg, Questions.angle),
            "--distance": (questions.distance_mm, Questions.distance),
            "--interval": (questions.interval_s, Questions.interval),
        }[option]
        if value is not None:
            return read_option(option, value, read)
        return default if self._questions is None else ask(self._questions, default)


def read_option(option: str, value: str, read: Callable[[str], T]) -> T:
    """The value of an option.

    Raises:
        BadParameter: it cannot be right; the message has the option and the reason.
    """
    try:
        return read(value)
    except AnswerError as error:
        raise typer.BadParameter(f"{option}: {error}") from None


def optics(
    answers: Answers,
) -> tuple[Sequence[HeadDescription], Sequence[float], Sequence[float]]:
    """Heads, focal lengths and pixel sizes, one of each for every head."""
    return answers.heads, answers.focal_lengths_mm, answers.pixel_sizes_um
