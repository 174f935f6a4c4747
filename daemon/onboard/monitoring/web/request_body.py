"""The body of a command: read when its sender is known, bounded, and parsed off the event loop."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator
from typing import Any

from fastapi import HTTPException, Request
from pydantic import ValidationError

from daemon.onboard.service.command_rules import CommandBody

BODY_MAX_BYTES = 16_384
BODY_MAX_S = 5.0
"""From the end of the header to the end of the body."""


COMMAND_OPENAPI = {
    "requestBody": {
        "required": False,
        "content": {"application/json": {"schema": CommandBody.model_json_schema()}},
    }
}
"""For the API's document: the route reads its body itself."""


async def command_body(request: Request) -> CommandBody:
    """Read and validate the body of a command.

    Raises:
        HTTPException: 408, 413, 415 or 422, with a sentence.
    """
    body = await _read(request.stream())
    if not body:
        return CommandBody()
    kind = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if kind != "application/json":
        raise HTTPException(415, "the body of a command is application/json")
    try:
        return await asyncio.to_thread(parse_command_body, body)
    except ValueError as error:
        raise HTTPException(422, str(error)) from error


def parse_command_body(body: bytes) -> CommandBody:
    """A command's body from JSON.

    Raises:
        ValueError: it is not strict JSON, nested too deeply, or no valid command body.
    """
    try:
        found = json.loads(
            body.decode("utf-8"), object_pairs_hook=_unique_keys, parse_constant=_refuse_constant
        )
    except RecursionError:
        raise ValueError("the body is nested too deeply") from None
    except ValueError as error:
        raise ValueError(f"the body is not JSON: {error}") from error
    if found is None:
        return CommandBody()
    try:
        return CommandBody.model_validate_json(json.dumps(found))
    except ValidationError as error:
        sentences = [f"{'.'.join(map(str, e['loc']))}: {e['msg']}" for e in error.errors()]
        raise ValueError("; ".join(sentences)) from error


async def _read(pieces: AsyncIterator[bytes]) -> bytes:
    read = bytearray()
    try:
        async with asyncio.timeout(BODY_MAX_S):
            async for piece in pieces:
                read += piece
                if len(read) > BODY_MAX_BYTES:
                    raise HTTPException(413, f"at most {BODY_MAX_BYTES} bytes are read")
    except TimeoutError:
        raise HTTPException(
            408, f"the body did not come within {BODY_MAX_S:.0f} s", {"Connection": "close"}
        ) from None
    return bytes(read)


def _unique_keys(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) != len(pairs):
        raise ValueError("a key is given twice")
    return found


def _refuse_constant(text: str) -> Any:
    raise ValueError(f"{text} is not a number")
