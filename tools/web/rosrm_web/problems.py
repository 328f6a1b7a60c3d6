"""Errors as answers: problem details (RFC 9457) with the sentences of the command line."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from http import HTTPStatus
from typing import Any, Final

from fastapi import Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse, Response
from pydantic import TypeAdapter
from starlette.exceptions import HTTPException

from rosrm.errors import ConfigError, NoMaster, Refused, RosrmError, describe_fault
from rosrm_web.master_link import Busy

MEDIA_TYPE: Final = "application/problem+json"
#: Codes of the master's refusals to status codes; all others are a conflict.
_STATUS: Final = {"unknown": 404, "denied": 403, "quota": 429, "invalid": 422, "unsure": 503}
#: Errors in a parameter or body that one answer names.
_MOST_FAULTS: Final = 10


@dataclass
class Problem:
    """Answer to a request that failed (RFC 9457).

    Attributes:
        detail: sentence for the user.
        code: the master's reason in one word; "": none.
    """

    type: str
    title: str
    status: int
    detail: str
    code: str = ""


#: Answers with errors, in OpenAPI.
RESPONSES: Final[dict[Any, Any]] = {
    "default": {
        "description": "The request failed.",
        "content": {MEDIA_TYPE: {"schema": TypeAdapter(Problem).json_schema()}},
    }
}

_log = logging.getLogger("rosrm.web")


def form(status: int, detail: str, code: str = "") -> dict[str, Any]:
    """Return the members of an answer.

    Args:
        status: HTTP status code.
        detail: sentence for the user.
        code: reason in one word; "": none.
    """
    title = HTTPStatus(status).phrase
    problem = {"type": "about:blank", "title": title, "status": status, "detail": detail}
    return {**problem, "code": code} if code else problem


def answer(
    status: int, detail: str, code: str = "", headers: dict[str, str] | None = None
) -> Response:
    """Return an answer; the arguments are those of `form`."""
    content = form(status, detail, code)
    return JSONResponse(content, status, headers=headers, media_type=MEDIA_TYPE)


def status_of(error: RosrmError) -> int:
    """Return the status code of an error."""
    if isinstance(error, Refused):
        return _STATUS.get(error.code, 409)
    if isinstance(error, (NoMaster, Busy)):
        return 503
    return 422 if isinstance(error, ConfigError) else 500


async def of_rosrm(_request: Request, error: RosrmError) -> Response:
    """Answer an error with a sentence for the user."""
    code = error.code if isinstance(error, Refused) else ""
    return answer(status_of(error), str(error), code)


async def of_http(_request: Request, error: HTTPException) -> Response:
    """Answer an unknown path, or a method that the path does not have."""
    return answer(error.status_code, str(error.detail), headers=dict(error.headers or {}))


async def of_validation(_request: Request, error: RequestValidationError) -> Response:
    """Answer a parameter or a body of another form; repeat no values of the request."""
    faults = error.errors()
    lines = [
        f"{'.'.join(map(str, one['loc']))}: {one['msg'].removeprefix('Value error, ')}"
        for one in faults[:_MOST_FAULTS]
    ]
    left = len(faults) - len(lines)
    return answer(422, "; ".join(lines + ([f"and {left} more"] if left else [])))


async def of_fault(_request: Request, error: Exception) -> Response:
    """Answer an error of the gateway itself; the log has its text."""
    _log.error("request failed: %s", describe_fault(error), exc_info=error)
    return answer(500, "the gateway failed; its log has the error")


#: Class of exceptions to its handler.
HANDLERS: Final[dict[Any, Any]] = {
    RosrmError: of_rosrm, HTTPException: of_http, RequestValidationError: of_validation,
    Exception: of_fault,
}  # fmt: skip
