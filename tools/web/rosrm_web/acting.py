"""Requests that act: submit, apply, cancel, move, drain and others."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Annotated, Final, TypeVar

from fastapi import Request
from fastapi.responses import JSONResponse, Response
from pydantic import BaseModel, ConfigDict, Field

from rosrm.cli.output import json_forms
from rosrm.config.documents import Node, Place, node_of, parse
from rosrm.config.work import checked_work
from rosrm.errors import ConfigError

if TYPE_CHECKING:
    from rosrm.client.client import Client
    from rosrm.model.applications import ApplyResult, Target
    from rosrm_web.gateway import Gateway

T = TypeVar("T")

#: Name of a work file of a request, in messages.
_WORK: Final = "work"
#: Relative paths of a work file start at the directory of this path.
_FILE: Final = "/work"
#: Media types of a work file.
WORK_TYPES: Final = ("application/json", "application/yaml")

Name = Annotated[str, Field(min_length=1, max_length=256)]
Names = Annotated[list[Name], Field(min_length=1, max_length=10_000)]


class _Body(BaseModel):
    """Body of a request, without unknown members."""

    model_config = ConfigDict(extra="forbid", strict=True)


class Processes(_Body):
    """Processes by their names."""

    processes: Names


class OneProcess(_Body):
    """A process by its name."""

    process: Name


class Move(OneProcess):
    """A process, and the host to which it moves; without a host the master chooses one."""

    host: Name | None = None


class OneHost(_Body):
    """A host by its name."""

    host: Name


class OneApplication(_Body):
    """An application by its name."""

    application: Name


class Version(OneApplication):
    """A kept version of an application."""

    version: Annotated[int, Field(ge=1)]


class Rebalance(_Body):
    """A round of moves, or only its plan."""

    plan: bool = False


@dataclass
class Message:
    """Answer to a request that acts: the message of the master."""

    message: str


class Acting:
    """Endpoints that act; the guard admits operators only."""

    def __init__(self, gateway: Gateway) -> None:
        self._gateway = gateway

    async def submit(self, request: Request) -> Response:
        """Queue the processes of a work file, all or none."""
        work = await _work(request)
        return await self._act(lambda client: client.submit(work.specs))

    async def apply(self, request: Request) -> Response:
        """Make an application as a work file with `app` describes it."""
        return await self._apply(await _application(request))

    async def plan(self, request: Request) -> Response:
        """Return the actions by which an application would become as described; begin none."""
        return await self._apply(await _application(request), plan_only=True)

    async def _apply(self, target: Target, *, plan_only: bool = False) -> Response:
        def apply(client: Client) -> ApplyResult:
            return client.apply_targets([target], plan_only=plan_only)

        return await self._show_plan(apply)

    async def revert(self, body: Version) -> Response:
        """Make an earlier version of an application the desired one again."""
        return await self._show_plan(lambda one: one.revert(body.application, body.version))

    async def cancel_application(self, body: OneApplication) -> Response:
        """Cancel all processes of an application; its versions stay."""
        return await self._show_plan(lambda one: one.cancel_application(body.application))

    async def cancel(self, body: Processes) -> Response:
        """Take processes out of the queue, or stop them for good."""
        return await self._act(lambda client: client.cancel(body.processes))

    async def restart(self, body: Processes) -> Response:
        """Restart processes on their hosts, or queue ended ones."""
        return await self._act(lambda client: client.restart(body.processes))

    async def move(self, body: Move) -> Response:
        """Begin to move a process to another host."""
        return await self._act(lambda client: client.migrate(body.process, body.host))

    async def checkpoint(self, body: OneProcess) -> Response:
        """Begin to checkpoint a process into an image on its host."""
        return await self._act(lambda client: client.checkpoint(body.process))

    async def restore(self, body: OneProcess) -> Response:
        """Begin to restore a process on the host of its image."""
        return await self._act(lambda client: client.restore(body.process))

    async def cordon(self, body: OneHost) -> Response:
        """Stop assigning processes to a host."""
        return await self._act(lambda client: client.cordon(body.host))

    async def uncordon(self, body: OneHost) -> Response:
        """Allow new processes on a host again."""
        return await self._act(lambda client: client.uncordon(body.host))

    async def drain(self, body: OneHost) -> Response:
        """Cordon a host, and begin to move away the processes that can leave it."""
        return await self._act(lambda client: client.drain(body.host))

    async def rebalance(self, body: Rebalance) -> Response:
        """Begin one round of moves that even out the load of the hosts."""
        return await self._act(lambda client: client.rebalance(plan_only=body.plan))

    async def _act(self, request: Callable[[Client], str]) -> Response:
        return JSONResponse({"message": await self._ask(request)})

    async def _show_plan(self, request: Callable[[Client], ApplyResult]) -> Response:
        result = await self._ask(request)
        return JSONResponse(json_forms.finite(json_forms.forms([result])[0]))

    async def _ask(self, request: Callable[[Client], T]) -> T:
        try:
            return await self._gateway.ask(self._gateway.acting, request)
        finally:
            self._gateway.forget_listings()


async def _application(request: Request) -> Target:
    return require_application(await _work(request), "/v1/submit")


def require_application(target: Target, otherwise: str) -> Target:
    """Return a target that is an application.

    Args:
        target: of a work file.
        otherwise: what runs single processes, for the message.
    """
    if target.application:
        return target
    raise ConfigError(
        f"{_WORK}: app: the name of the application is required, such as `app: navigation`. To run "
        f"single processes, use {otherwise}"
    )


async def _work(request: Request) -> Target:
    """Return the checked work file in the body of a request."""
    media_type = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if media_type not in WORK_TYPES:
        raise ConfigError(f"a work file has the content type {' or '.join(WORK_TYPES)}")
    check = partial(checked_work_file, await request.body(), is_json=media_type == WORK_TYPES[0])
    return await asyncio.get_running_loop().run_in_executor(None, check)


def checked_work_file(body: bytes, *, is_json: bool) -> Target:
    """Return the desired state in a work file that came over the network."""
    try:
        text = body.decode()
        root = _json(text) if is_json else parse(text, _WORK)
        target = checked_work(root, _FILE, None, check_artifacts=False)
    except UnicodeDecodeError:
        raise ConfigError(f"{_WORK}: UTF-8 is required") from None
    except RecursionError:
        raise ConfigError(f"{_WORK}: lists and mappings are nested too deeply") from None
    for spec in target.specs:
        for artifact in spec.artifacts:
            if artifact.source:
                raise ConfigError(
                    f"{_WORK}: artifacts.{artifact.name}: a request cannot name files of the "
                    "gateway's machine; use `rosrm submit` or `rosrm apply`"
                )
    return target


def _json(text: str) -> Node:
    try:
        return node_of(json.loads(text), Place(_WORK, 0, 0))
    except ValueError as error:
        raise ConfigError(f"{_WORK}: unreadable JSON: {error}") from None
