"""Tokens are shown once, kept as hashes, and guessing them is slow."""

from __future__ import annotations

from pathlib import Path

import pytest

from daemon.onboard.monitoring.access.tokens import (
    FailedAttempts,
    TokenError,
    add_token,
    read_tokens,
    remove_token,
)


def test_a_token_is_known_by_its_hash_only(tmp_path: Path) -> None:
    path = tmp_path / "tokens.toml"
    pilot = add_token(path, "pilot", "observer")
    operator = add_token(path, "operator", "operator")
    assert pilot not in path.read_text()
    assert path.stat().st_mode & 0o777 == 0o640
    tokens = read_tokens(path)
    assert tokens.holder_of(operator) is not None
    assert tokens.holder_of(operator).role == "operator"
    assert tokens.holder_of(pilot).name == "pilot"
    assert tokens.holder_of(operator + "x") is None
    assert tokens.holder_of("") is None
    assert tokens.holder_of("\udcff") is None
    remove_token(path, "pilot")
    assert read_tokens(path).holder_of(pilot) is None


def test_a_name_has_one_token_and_odd_names_none(tmp_path: Path) -> None:
    path = tmp_path / "tokens.toml"
    add_token(path, "operator", "operator")
    with pytest.raises(TokenError, match="has a token"):
        add_token(path, "operator", "observer")
    for name in ("", "a b", "a]\n[root", "x" * 65):
        with pytest.raises(TokenError):
            add_token(path, name, "observer")
    with pytest.raises(TokenError, match="no token has the name"):
        remove_token(path, "pilot")


def test_a_file_readable_by_all_users_or_damaged_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "tokens.toml"
    add_token(path, "operator", "operator")
    path.chmod(0o644)
    with pytest.raises(TokenError, match="chmod 640"):
        read_tokens(path)
    path.chmod(0o640)
    for role in ("root", "command", "watch"):
        path.write_text(f'[x]\nrole = "{role}"\nsha256 = "{"0" * 64}"\n')
        with pytest.raises(TokenError, match=f"'{role}'; a token needs a role .observer, operator"):
            read_tokens(path)


def test_after_five_wrong_tokens_an_address_waits_a_minute() -> None:
    attempts = FailedAttempts()
    for i in range(5):
        assert not attempts.is_blocked("10.0.0.9", float(i))
        attempts.failed("10.0.0.9", float(i))
    assert attempts.is_blocked("10.0.0.9", 5.0)
    assert not attempts.is_blocked("10.0.0.8", 5.0)
    assert not attempts.is_blocked("10.0.0.9", 66.0)


def test_many_addresses_do_not_fill_the_memory() -> None:
    attempts = FailedAttempts()
    for i in range(10_000):
        attempts.failed(f"fd00::{i:x}", 0.0)
    assert len(attempts._failures) <= 4096
