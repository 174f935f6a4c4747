"""Errors of the API as problem+json (RFC 9457)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from fastapi import Request, Response
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from pydantic import BaseModel
from starlette.exceptions import HTTPException as StarletteHTTPException

from daemon.onboard.monitoring.server_messages import message_of

PROBLEM_JSON = "application/problem+json"


class Problem(BaseModel):
    """An error, RFC 9457."""

    type: str = "about:blank"
    title: str
    status: int
    detail: str = ""
    message: dict[str, Any] | None = None
    """Code and parameters of the detail."""
    title_message: dict[str, Any] | None = None


def documented_problem() -> dict[str, Any]:
    schema = Problem.model_json_schema()
    return {"description": "what is wrong", "content": {PROBLEM_JSON: {"schema": schema}}}


async def http_problem(_request: Request, error: Exception) -> Response:
    assert isinstance(error, StarletteHTTPException)
    headers = dict(error.headers or {})
    return _problem(error.status_code, str(error.detail), headers)


async def validation_problem(_request: Request, error: Exception) -> Response:
    assert isinstance(error, RequestValidationError)
    sentences = [f"{'.'.join(map(str, e['loc'][1:]))}: {e['msg']}" for e in error.errors()]
    return _problem(422, "; ".join(sentences))


def _problem(status: int, detail: str, headers: Mapping[str, str] | None = None) -> JSONResponse:
    title = _title(status)
    problem = Problem(
        title=title,
        status=status,
        detail=detail,
        message=message_of(detail),
        title_message=message_of(title),
    )
    content = problem.model_dump(exclude_none=True)
    return JSONResponse(content, status, headers, PROBLEM_JSON)


def _title(status: int) -> str:
    titles: Mapping[int, str] = {
        401: "Token rejected",
        403: "Not allowed",
        404: "Not found",
        405: "No such method",
        408: "Too slow",
        409: "Not possible now",
        413: "Too large",
        415: "Not JSON",
        422: "Not understood",
        429: "Too many attempts",
        504: "No answer",
    }
    return titles.get(status, "Not done")
