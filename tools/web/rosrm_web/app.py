"""The HTTP application: the table of all routes."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from fastapi import FastAPI, HTTPException

from rosrm.model.applications import ApplicationRow, ApplyResult
from rosrm.model.rows import EventRow, ProcessRow
from rosrm.version import __version__
from rosrm_web import problems
from rosrm_web.acting import WORK_TYPES, Acting, Message
from rosrm_web.changes import Changes
from rosrm_web.metrics.endpoint import Metrics
from rosrm_web.page.login import Login
from rosrm_web.page.site import mount
from rosrm_web.reading import Host, Log, Reading, Status
from rosrm_web.sessions import Sessions
from rosrm_web.tokens import LOGIN

if TYPE_CHECKING:
    from rosrm_web.access import Access
    from rosrm_web.gateway import Gateway
    from rosrm_web.settings import Settings


#: Body of a request with a work file, in OpenAPI.
_WORK_FILE: Final = {
    "description": "A work file, as docs/reference/configuration.md describes it.",
    "required": True,
    "content": {media_type: {"schema": {"type": "object"}} for media_type in WORK_TYPES},
}
_WITH_WORK_FILE: Final = frozenset({"/v1/submit", "/v1/apply", "/v1/plan"})


class Route(NamedTuple):
    """A path, its method and endpoint, and the type of its answer for OpenAPI."""

    method: str
    path: str
    endpoint: Callable[..., Any]
    answer: Any


def routes(gateway: Gateway, access: Access) -> list[Route]:
    """Return all routes."""
    read, act = Reading(gateway), Acting(gateway)
    return [
        Route("GET", "/v1/status", read.status, Status),
        Route("GET", "/v1/hosts", read.hosts, list[Host]),
        Route("GET", "/v1/processes", read.processes, list[ProcessRow]),
        Route("GET", "/v1/apps", read.applications, list[ApplicationRow]),
        Route("GET", "/v1/events", read.events, list[EventRow]),
        Route("GET", "/v1/changes", Changes(gateway).follow, None),
        Route("GET", "/v1/explain/{process}", read.explain, dict[str, Any]),
        Route("GET", "/v1/logs/{process}", read.logs, Log),
        Route("GET", "/metrics", Metrics(gateway, access).metrics, None),
        Route("POST", "/v1/submit", act.submit, Message),
        Route("POST", "/v1/apply", act.apply, ApplyResult),
        Route("POST", "/v1/plan", act.plan, ApplyResult),
        Route("POST", "/v1/revert", act.revert, ApplyResult),
        Route("POST", "/v1/cancel", act.cancel, Message),
        Route("POST", "/v1/cancel-app", act.cancel_application, ApplyResult),
        Route("POST", "/v1/restart", act.restart, Message),
        Route("POST", "/v1/move", act.move, Message),
        Route("POST", "/v1/checkpoint", act.checkpoint, Message),
        Route("POST", "/v1/restore", act.restore, Message),
        Route("POST", "/v1/cordon", act.cordon, Message),
        Route("POST", "/v1/uncordon", act.uncordon, Message),
        Route("POST", "/v1/drain", act.drain, Message),
        Route("POST", "/v1/rebalance", act.rebalance, Message),
    ]


def create_app(
    gateway: Gateway, settings: Settings, access: Access, sessions: Sessions | None = None
) -> FastAPI:
    """Return the application; `guard.Guard` has to stand before it."""
    app = FastAPI(
        title="rosrm", version=__version__, openapi_url="/v1/openapi.json",
        responses=problems.RESPONSES,
        docs_url=None, redoc_url=None,  # both load scripts from the internet
    )  # fmt: skip
    for method, path, endpoint, answer in routes(gateway, access):
        extra = {"requestBody": _WORK_FILE} if path in _WITH_WORK_FILE else None
        app.add_api_route(
            path, endpoint, methods=[method], response_model=answer, openapi_extra=extra
        )
    for kind, handler in problems.HANDLERS.items():
        app.add_exception_handler(kind, handler)
    login = Login(settings, access, sessions or Sessions(access))
    app.add_api_route(LOGIN, login.show, methods=["GET"], include_in_schema=False)
    app.add_api_route(LOGIN, login.enter, methods=["POST"], include_in_schema=False)
    app.add_api_route("/v1/{path:path}", _unknown_path, include_in_schema=False)
    mount(app, gateway, access)  # takes all other paths
    return app


async def _unknown_path() -> None:
    """Refuse an unknown path below /v1 as JSON; the page would answer it with HTML."""
    raise HTTPException(404)
