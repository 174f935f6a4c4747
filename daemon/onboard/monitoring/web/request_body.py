"""The body of a command: read when its sender is known, bounded, and parsed off the event loop."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator

from fastapi import HTTPException, Request
from pydantic import ValidationError

from daemon.mission.canonical_json import parse_record
from daemon.onboard.service.command_rules import CommandBody
from processing.rig.problem_sentences import findings_of, sentences

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
    if body.strip() == b"null":
        return CommandBody()
    found = parse_record(body, "the body")
    try:
        return CommandBody.model_validate_json(json.dumps(found))
    except ValidationError as error:
        raise ValueError(". ".join(sentences(findings_of(error)))) from error


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
