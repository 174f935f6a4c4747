"""Redaction of a document before it is shared: secrets, by their key or form.

Documents are parsed first, so that neither quoting nor line breaks hide a key. What cannot be
parsed is not for these functions: it is left out as a whole.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

REDACTED = "left out"
_SECRET_WORDS = r"token|secret|passw|passphrase|pwd|key|credential|auth|cookie|bearer|psk"
_SECRET_KEY = re.compile(_SECRET_WORDS, re.IGNORECASE)
_SECRET_TEXTS = (
    # A name and perhaps a password before the host of an address.
    (re.compile(r"([A-Za-z][A-Za-z0-9+.\-]*://)[^/?#\s\"']*@"), rf"\1{REDACTED}@"),
    (re.compile(r"(?i)(authorization\s*[:=]\s*)[^\r\n]+"), rf"\1{REDACTED}"),
    (re.compile(r"(?i)\b(bearer|basic)\s+[A-Za-z0-9._~+/=\-]+"), rf"\1 {REDACTED}"),
    # A parameter of an address, or an assignment within a text.
    (
        re.compile(
            rf"([\w.\-]*(?:{_SECRET_WORDS})[\w.\-]*\s*[=:]\s*)[^&;,\s\"'}}\]]+", re.IGNORECASE
        ),
        rf"\1{REDACTED}",
    ),
    (re.compile(r"\bsyn_[A-Za-z0-9_\-]{16,}"), REDACTED),
    (re.compile(r"-----BEGIN[\s\S]*?(-----END[^-]*-----|\Z)"), REDACTED),
)


def without_secrets(content: Any) -> Any:
    """The same tables, lists and values; those that are secret are replaced by "left out".

    Args:
        content: what a TOML or JSON parser gave.
    """
    if isinstance(content, Mapping):
        return {
            text_without_secrets(str(key)): REDACTED
            if _SECRET_KEY.search(str(key))
            else without_secrets(value)
            for key, value in content.items()
        }
    if isinstance(content, list | tuple):
        return [without_secrets(value) for value in content]
    return text_without_secrets(content) if isinstance(content, str) else content


def text_without_secrets(text: str) -> str:
    """A text without the credentials of addresses, assignments to secret names, tokens and keys."""
    for pattern, replacement in _SECRET_TEXTS:
        text = pattern.sub(replacement, text)
    return text
