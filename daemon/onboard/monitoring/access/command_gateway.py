"""Path of commands to the service and of its answers back.

Every command passes here, whatever way it came, and needs a role; an attempt that is refused is
recorded. The service decides the rest: a command gets a number and waits for its answer, for a
limited time.
"""

from __future__ import annotations

import asyncio
import itertools
import time
from collections.abc import Callable, Mapping
from typing import Any

from daemon import DaemonError
from daemon.onboard.monitoring.access.roles import COMMAND_ROLES, Principal, missing_role
from daemon.onboard.monitoring.web.refusal_limiter import SUMMARY_EVERY_S, RefusalLimiter
from daemon.onboard.service.messages import Answer, CommandRefused, ServiceCommand

ANSWER_TIMEOUT_S = 5.0


class AnswerTimeoutError(DaemonError):
    """The service did not answer in time."""


class NotPermittedError(DaemonError):
    """The sender does not have the required role."""


class CommandGateway:
    """Pending commands.

    Args:
        send: hands a command, or the record of a refused one, to the service; never blocks for
            long.
    """

    def __init__(self, send: Callable[[ServiceCommand | CommandRefused], None]) -> None:
        self._send = send
        self._limiter = RefusalLimiter()
        self._summary: asyncio.TimerHandle | None = None
        self._numbers = itertools.count(1)
        self._waiting: dict[int, asyncio.Future[Answer]] = {}

    async def command(self, name: str, arguments: Mapping[str, Any], by: Principal) -> Answer:
        """Send a command and wait for the answer.

        Raises:
            NotPermittedError: the role does not permit it; the attempt is recorded.
            AnswerTimeoutError: none came in time.
        """
        self.admit(name, by)
        number = next(self._numbers)
        answer: asyncio.Future[Answer] = asyncio.get_running_loop().create_future()
        self._waiting[number] = answer
        try:
            self._send(
                ServiceCommand(number, name, dict(arguments), by.name, str(by.role), by.address)
            )
            return await asyncio.wait_for(answer, ANSWER_TIMEOUT_S)
        except TimeoutError as error:
            raise AnswerTimeoutError(
                f"the service did not answer within {ANSWER_TIMEOUT_S:.0f} s; see its log"
            ) from error
        finally:
            del self._waiting[number]

    def admit(self, name: str, by: Principal) -> None:
        """Check that a role permits a command, before its arguments are read.

        Raises:
            NotPermittedError: it does not; the attempt is recorded.
        """
        needed = missing_role(by, name)
        if needed is not None:
            sentence = f"{by.name} has the role {by.role}; {name} needs the role {needed}"
            self.refuse(name, by, sentence)
            raise NotPermittedError(sentence)

    def refuse(self, name: str, by: Principal, sentence: str) -> None:
        """Record an attempt that is refused; many of them are summarized once a minute.

        Args:
            name: of the command; one that does not exist is recorded as "unknown".
            by: who tried; the role is None where that is not known.
            sentence: why it is refused.
        """
        if self._limiter.is_recorded(by.address, time.monotonic()):
            known = name if name in COMMAND_ROLES else "unknown"
            self._send(CommandRefused(known, by.name, by.role or "none", by.address, sentence))
        elif self._summary is None:
            loop = asyncio.get_running_loop()
            self._summary = loop.call_later(SUMMARY_EVERY_S, self._summarize)

    def _summarize(self) -> None:
        self._summary = None
        count, sentence = self._limiter.summary()
        if count:
            self._send(CommandRefused("several", "several", "none", "", sentence, count))

    def on_answer(self, answer: Answer) -> None:
        """Handle an answer of the service; a late one is dropped."""
        waiting = self._waiting.get(answer.number)
        if waiting is not None and not waiting.done():
            waiting.set_result(answer)
