"""Each type of message has one handler."""

from __future__ import annotations

import pytest

from daemon.onboard.service.message_dispatcher import MessageDispatcher
from daemon.onboard.service.messages import Ping, Stop


def test_a_message_goes_to_the_one_handler_of_its_type() -> None:
    handled: list[object] = []
    dispatcher = MessageDispatcher()
    dispatcher.add({Ping: handled.append})
    dispatcher.add({Stop: lambda _: None})
    dispatcher.dispatch(Ping())
    dispatcher.dispatch(Stop())
    assert handled == [Ping()]


def test_a_type_without_a_handler_and_one_with_two_are_named() -> None:
    dispatcher = MessageDispatcher()
    dispatcher.add({Ping: lambda _: None})
    with pytest.raises(TypeError, match="Stop, which has no handler"):
        dispatcher.dispatch(Stop())
    with pytest.raises(ValueError, match="two handlers: Ping"):
        dispatcher.add({Ping: lambda _: None, Stop: lambda _: None})
