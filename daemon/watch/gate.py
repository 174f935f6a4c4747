"""The way from a watcher's command to the service and its answer back.

The service decides; here a command only gets a number, waits for its answer, and gives up in time.
"""

from __future__ import annotations

import asyncio
import itertools
from collections.abc import Callable, Mapping
from typing import Any

from daemon.service.messages import Answer, Command

ANSWER_TIMEOUT_S = 5.0


class NoAnswerError(RuntimeError):
    """The service did not answer in time."""


class Gate:
    """Commands on their way.

    Args:
        send: hands a command to the service; never blocks for long.
    """

    def __init__(self, send: Callable[[Command], None]) -> None:
        self._send = send
        self._numbers = itertools.count(1)
        self._waiting: dict[int, asyncio.Future[Answer]] = {}

    async def command(self, name: str, arguments: Mapping[str, Any], by: str) -> Answer:
        """Give a command and wait for the answer.

        Raises:
            NoAnswerError: none came in time.
        """
        number = next(self._numbers)
        answer: asyncio.Future[Answer] = asyncio.get_running_loop().create_future()
        self._waiting[number] = answer
        try:
            self._send(Command(number, name, dict(arguments), by))
            return await asyncio.wait_for(answer, ANSWER_TIMEOUT_S)
        except TimeoutError as error:
            raise NoAnswerError(
                f"the service did not answer within {ANSWER_TIMEOUT_S:.0f} s; look at its log"
            ) from error
        finally:
            del self._waiting[number]

    def answered(self, answer: Answer) -> None:
        """The service's answer has come; one that is too late is dropped."""
        waiting = self._waiting.get(answer.number)
        if waiting is not None and not waiting.done():
            waiting.set_result(answer)
