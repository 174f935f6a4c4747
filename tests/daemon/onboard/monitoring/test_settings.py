"""Settings under which a token would be sent without encryption are refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from pydantic import ValidationError

from daemon.configuration.model import WatchSection

FILE = Path("x")


@pytest.mark.parametrize("host", ["0.0.0.0", "192.168.1.5", "::", "fd00::1"])
def test_tokens_leave_the_machine_with_tls_only(host: str) -> None:
    with pytest.raises(ValidationError, match="without encryption"):
        WatchSection(host=host, tokens=FILE)
    WatchSection(host=host, tokens=FILE, tls_certificate=FILE, tls_key=FILE)
    WatchSection(host=host)  # watching alone needs none


@pytest.mark.parametrize("host", ["127.0.0.1", "127.4.5.6", "::1", "localhost"])
def test_within_the_machine_they_may(host: str) -> None:
    WatchSection(host=host, tokens=FILE)


@pytest.mark.parametrize("half", [{"tls_certificate": FILE}, {"tls_key": FILE}])
def test_half_of_tls_is_none(half: dict[str, Any]) -> None:
    with pytest.raises(ValidationError, match="belong together"):
        WatchSection(**half)
