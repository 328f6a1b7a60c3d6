"""Requests that read: status, hosts, processes, applications, events, explanations, logs."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, make_dataclass
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any, Final, get_type_hints

from fastapi import Path, Query
from fastapi.responses import JSONResponse, Response

from rosrm.cli.output import json_forms
from rosrm.client.logs import LogSelection
from rosrm.errors import NoMaster
from rosrm.model.rows import HostRow, PluginRow
from rosrm.model.values import LARGEST_NUMBER, HostDescription
from rosrm_web.watching import MOST_EVENTS, give_up_early

if TYPE_CHECKING:
    from rosrm.archive.reader import LogArchive
    from rosrm.client.client import Client
    from rosrm.model.rows import Listing
    from rosrm_web.gateway import Gateway
    from rosrm_web.master_link import MasterLink

#: Most last lines of a log in one answer.
MOST_LINES: Final = 10_000
#: Bytes of a log in one answer, after which no further chunk is added.
MOST_LOG_BYTES: Final = 1_000_000
#: Characters of a name in a request; no name is longer.
_LONGEST_NAME: Final = 256

Name = Annotated[str, Path(max_length=_LONGEST_NAME, description="Name of a process.")]
_Filter = Query(max_length=_LONGEST_NAME, description='Name; "": all.')


def _host_form() -> type[Any]:
    """Return a class with the members of a host in JSON: those of its description come first."""
    own = {name: hint for name, hint in get_type_hints(HostRow).items() if name != "description"}
    return make_dataclass("Host", {**get_type_hints(HostDescription), **own}.items())


Host: Any = _host_form()


@dataclass
class Master:
    """Condition of the master as the gateway sees it, as in `MasterState`."""

    state: str
    reason: str


@dataclass
class Status:
    """Answer of /v1/status: `rosrm status --json`, and the gateway's view of the master.

    While the master does not answer, only `gateway` is there.
    """

    gateway: Master
    master: str = ""
    uptime: float = 0.0
    last_sequence: int = 0
    trouble: str = ""
    security: str = ""
    strangers: str = ""
    hosts: Mapping[str, int] = field(default_factory=dict)
    processes: Mapping[str, int] = field(default_factory=dict)
    failing_plugins: Sequence[PluginRow] = ()


@dataclass
class LogChunkForm:
    """Output that one instance of a process wrote.

    Attributes:
        dropped: bytes before the text that the bound on logs removed.
        text: the output; bytes that are no UTF-8 are replaced.
    """

    process: str
    host: str
    number: int
    offset: int
    dropped: int
    text: str


@dataclass
class Log:
    """Answer of /v1/logs.

    Attributes:
        notes: sentences about parts that cannot be read.
        is_cut: the answer has reached its bound; `tail` or `since` select another part.
    """

    chunks: Sequence[LogChunkForm]
    notes: Sequence[str]
    is_cut: bool


class Reading:
    """Endpoints that change nothing."""

    def __init__(self, gateway: Gateway) -> None:
        self._gateway = gateway

    async def status(self) -> Response:
        """Show an overview, also while the master is lost."""
        try:
            listing = await self._gateway.list(hosts=True, processes=True, plugins="failing")
        except NoMaster as error:
            state = "searching" if self._gateway.watcher.master.state == "searching" else "lost"
            return _answer({"gateway": {"state": state, "reason": str(error)}})
        up = {"gateway": {"state": "up", "reason": ""}}
        return _answer(up | json_forms.status_form(listing))

    async def hosts(self) -> Response:
        """List the hosts and their usage."""
        listing = await self._gateway.list(hosts=True)
        return _answer(json_forms.forms(listing.hosts))

    async def processes(self) -> Response:
        """List the processes, ended ones too."""
        listing = await self._gateway.list(processes=True)
        return _answer(json_forms.forms(listing.processes))

    async def applications(self) -> Response:
        """List the applications with their versions."""
        listing = await self._gateway.list(applications=True)
        return _answer(json_forms.forms(listing.applications))

    async def events(
        self,
        process: Annotated[str, _Filter] = "",
        host: Annotated[str, _Filter] = "",
        after: Annotated[
            int, Query(ge=0, le=LARGEST_NUMBER, description="Sequence before the first event.")
        ] = 0,
        newest: Annotated[int, Query(ge=1, le=MOST_EVENTS, description="Most events.")] = 100,
    ) -> Response:
        """List events, the oldest first."""

        def ask(client: Client) -> Listing:
            return client.list(
                events=True, process=process, host=host, after=after, newest=newest,
                on_wait=give_up_early,
            )  # fmt: skip

        listing = await self._gateway.ask(self._gateway.reading, ask)
        return _answer(json_forms.forms(listing.events))

    async def explain(self, process: Name) -> Response:
        """Explain the placement of a process, or why it waits."""
        explanation = await self._gateway.ask(
            self._gateway.acting, lambda client: client.explain(process)
        )
        return _answer(dict(explanation))

    async def logs(
        self,
        process: Name,
        tail: Annotated[int, Query(ge=1, le=MOST_LINES, description="Number of last lines.")] = 200,
        since: Annotated[float, Query(ge=0.0, description="Unix time of the oldest output.")] = 0.0,
        host: Annotated[str, _Filter] = "",
    ) -> Response:
        """Read the output of a process, over restarts and migrations; `since` replaces `tail`."""
        selection = LogSelection(0 if since else tail, since, host)
        link = self._gateway.logs
        read = partial(
            _read_log, process=process, selection=selection, link=link,
            open_archive=self._gateway.open_archive,
        )  # fmt: skip
        return _answer(await self._gateway.ask(link, read))


def _read_log(
    client: Client, process: str, selection: LogSelection, link: MasterLink,
    open_archive: Callable[[], LogArchive | None],
) -> dict[str, Any]:  # fmt: skip
    (reader,) = client.log_readers([process], selection, open_archive())
    chunks: list[dict[str, Any]] = []
    size = 0
    for chunk in reader.read():
        size += len(chunk.content)
        text = chunk.content.decode(errors="replace")
        chunks.append({
            "process": chunk.process, "host": chunk.host, "number": chunk.number,
            "offset": chunk.offset, "dropped": chunk.dropped, "text": text,
        })  # fmt: skip
        if size >= MOST_LOG_BYTES:
            break
    return {"chunks": chunks, "notes": list(link.notes), "is_cut": size >= MOST_LOG_BYTES}


def _answer(content: Any) -> Response:
    return JSONResponse(json_forms.finite(content))
