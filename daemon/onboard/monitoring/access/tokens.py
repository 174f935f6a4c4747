"""Access tokens: stored as hashes, compared in constant time, with limited attempts.

A token is 256 random bits, so that one SHA-256 is a sufficient hash. It is shown once, on creation.
"""

from __future__ import annotations

import hashlib
import hmac
import os
import re
import secrets
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from daemon import DaemonError
from daemon.mission.store import durable
from daemon.onboard.monitoring.access.roles import ROLES, Role
from processing.rig.toml_text import parse_toml

TOKEN_BYTES = 32
PREFIX = "syn_"
FAILURES_ALLOWED = 5
FAILURE_WINDOW_S = 60.0
ADDRESSES_MAX = 4096
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._@\-]{0,63}")
_HASH = re.compile(r"[0-9a-f]{64}")


class TokenError(DaemonError):
    """A token file that cannot be used, or a name that cannot be given."""


@dataclass(frozen=True)
class TokenHolder:
    """Holder of a token, with role."""

    name: str
    role: Role


@dataclass(frozen=True)
class Tokens:
    """Holders by the hash of their token, hexadecimal."""

    holders: Mapping[str, TokenHolder]

    def holder_of(self, token: str) -> TokenHolder | None:
        """The holder of a token; every hash is compared, in constant time."""
        given = _hash_of(token)
        found = None
        for known, holder in self.holders.items():
            if hmac.compare_digest(known, given):
                found = holder
        return found


class FailedAttempts:
    """Counts wrong tokens by address; more than a few per minute are refused unchecked."""

    def __init__(self) -> None:
        self._failures: dict[str, deque[float]] = {}

    def is_blocked(self, address: str, now_s: float) -> bool:
        failures = self._failures.get(address)
        if failures is None:
            return False
        while failures and now_s - failures[0] > FAILURE_WINDOW_S:
            failures.popleft()
        return len(failures) >= FAILURES_ALLOWED

    def failed(self, address: str, now_s: float) -> None:
        if len(self._failures) >= ADDRESSES_MAX:
            del self._failures[next(iter(self._failures))]
        self._failures.setdefault(address, deque(maxlen=FAILURES_ALLOWED)).append(now_s)


def read_tokens(path: Path | None) -> Tokens:
    """The holders of a token file; empty if the file does not exist.

    Raises:
        TokenError: not readable, not as written by `add_token`, or readable by all users.
    """
    if path is None or not path.exists():
        return Tokens({})
    try:
        if path.stat().st_mode & 0o007:
            raise TokenError(f"{path} is readable by all users; run: chmod 640 {path}")
        content = parse_toml(path.read_bytes())
    except (OSError, ValueError) as error:
        raise TokenError(f"{path}: cannot be read ({error})") from error
    holders: dict[str, TokenHolder] = {}
    for name, entry in content.items():
        role = entry.get("role") if isinstance(entry, dict) else None
        hashed = entry.get("sha256") if isinstance(entry, dict) else None
        if role not in ROLES or not isinstance(hashed, str) or not _HASH.fullmatch(hashed):
            raise TokenError(
                f"{path}: {name}: the role is {str(role)[:20]!r}; a token needs a role "
                f"({', '.join(ROLES)}) and its sha256. Remove the entry and make the token again "
                "(syntopic token add)"
            )
        holders[hashed] = TokenHolder(name, role)
    return Tokens(holders)


def add_token(path: Path, name: str, role: Role) -> str:
    """Create a token, store its hash, and return it; it cannot be read again.

    Raises:
        TokenError: a name that is none, or that has a token already.
    """
    if not _NAME.fullmatch(name):
        raise TokenError(f"{name!r}: letters, digits and . _ @ - only, 64 at most")
    holders = dict(read_tokens(path).holders)
    if any(holder.name == name for holder in holders.values()):
        raise TokenError(f"{name} has a token; remove it first (syntopic token remove {name})")
    token = PREFIX + secrets.token_urlsafe(TOKEN_BYTES)
    holders[_hash_of(token)] = TokenHolder(name, role)
    _write(path, holders)
    return token


def remove_token(path: Path, name: str) -> None:
    """Revoke a token.

    Raises:
        TokenError: no token has that name.
    """
    holders = dict(read_tokens(path).holders)
    remaining = {hashed: holder for hashed, holder in holders.items() if holder.name != name}
    if len(remaining) == len(holders):
        raise TokenError(f"{path}: no token has the name {name}")
    _write(path, remaining)


def _write(path: Path, holders: Mapping[str, TokenHolder]) -> None:
    durable.make_directories(path.absolute().parent)
    lines = ["# Hashes of tokens; written by `syntopic token`."]
    for hashed, holder in sorted(holders.items(), key=lambda item: item[1].name):
        lines += ["", f'["{holder.name}"]', f'role = "{holder.role}"', f'sha256 = "{hashed}"']
    owner = path.stat() if path.exists() else None
    durable.replace_file(path, "\n".join([*lines, ""]).encode(), mode=0o640)
    if owner is not None and os.geteuid() == 0:
        os.chown(path, owner.st_uid, owner.st_gid)


def _hash_of(token: str) -> str:
    return hashlib.sha256(token.encode("utf-8", "surrogatepass")).hexdigest()
