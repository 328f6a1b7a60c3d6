"""The HTTP application: the table of all routes."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

from fastapi import FastAPI

from rosrm.model.applications import ApplicationRow
from rosrm.model.rows import EventRow, ProcessRow
from rosrm.version import __version__
from rosrm_web import problems
from rosrm_web.reading import Host, Log, Reading, Status

if TYPE_CHECKING:
    from rosrm_web.gateway import Gateway


class Route(NamedTuple):
    """A path, its method and endpoint, and the type of its answer for OpenAPI."""

    method: str
    path: str
    endpoint: Callable[..., Any]
    answer: Any


def routes(gateway: Gateway) -> list[Route]:
    """Return all routes."""
    read = Reading(gateway)
    return [
        Route("GET", "/v1/status", read.status, Status),
        Route("GET", "/v1/hosts", read.hosts, list[Host]),
        Route("GET", "/v1/processes", read.processes, list[ProcessRow]),
        Route("GET", "/v1/apps", read.applications, list[ApplicationRow]),
        Route("GET", "/v1/events", read.events, list[EventRow]),
        Route("GET", "/v1/explain/{process}", read.explain, dict[str, Any]),
        Route("GET", "/v1/logs/{process}", read.logs, Log),
    ]


def create_app(gateway: Gateway) -> FastAPI:
    """Return the application; `guard.Guard` has to stand before it."""
    app = FastAPI(
        title="rosrm", version=__version__, openapi_url="/v1/openapi.json",
        docs_url=None, redoc_url=None,  # both load scripts from the internet
    )  # fmt: skip
    for method, path, endpoint, answer in routes(gateway):
        app.add_api_route(path, endpoint, methods=[method], response_model=answer)
    for kind, handler in problems.HANDLERS.items():
        app.add_exception_handler(kind, handler)
    # The page is mounted here, below the same guard, with `gateway` as its source.
    return app
