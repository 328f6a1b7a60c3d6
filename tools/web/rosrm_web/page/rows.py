"""Rows of the page's tables, and the problems of a cluster, from a listing. Pure."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from rosrm.cli.output.tables import free_devices
from rosrm.model.rows import EventRow, HostRow, Listing, ProcessRow, ResourceRow
from rosrm.wording import counted, first_line, percent, size, words

Row = Mapping[str, Any]

#: States of hosts and of processes that are not well, the gravest first, with their styles.
_HOST_TROUBLE: Final = {"lost": "bad", "suspect": "poor"}
PROCESS_TROUBLE: Final = {
    "failed": "bad", "unreachable": "bad", "stuck": "bad", "set_aside": "poor", "backoff": "poor",
}  # fmt: skip
#: Resources of a host in the table of hosts, each with a column of its own.
RESOURCES: Final = ("cpu", "memory", "disk")


@dataclass(frozen=True, slots=True)
class Problem:
    """Hosts or processes in one bad state.

    Attributes:
        table: "hosts" or "processes".
        state: of all of them.
        text: number and state.
    """

    table: str
    state: str
    text: str


@dataclass(frozen=True, slots=True)
class Changed:
    """The difference of two tables, as a transaction of AG Grid."""

    add: Sequence[Row]
    update: Sequence[Row]
    remove: Sequence[Row]

    def __bool__(self) -> bool:
        return bool(self.add or self.update or self.remove)

    def transaction(self) -> dict[str, Sequence[Row]]:
        """Return the argument of `applyTransaction`."""
        return {"add": self.add, "update": self.update, "remove": self.remove}


def changed(before: Mapping[str, Row], after: Mapping[str, Row]) -> Changed:
    """Return the difference of two tables by the ids of their rows."""
    return Changed(
        [row for key, row in after.items() if key not in before],
        [row for key, row in after.items() if key in before and before[key] != row],
        [{"id": key} for key in before if key not in after],
    )


def host_rows(hosts: Iterable[HostRow]) -> dict[str, Row]:
    """Return the rows of the table of hosts by their ids."""
    return {row.description.name: _host(row) for row in hosts}


def _host(row: HostRow) -> Row:
    marks = [
        name for name, is_set in (("cordoned", row.cordoned), ("draining", row.draining)) if is_set
    ]
    resources = {one.name: one for one in row.resources}
    usages = {name: resources[name] for name in RESOURCES if name in resources}
    others = [
        f"{name} {percent(one.usage)} %" for name, one in resources.items() if name not in usages
    ]
    return {
        "id": row.description.name,
        "host": row.description.name,
        "state": ", ".join([row.state, *marks]),
        "style": _HOST_TROUBLE.get(row.state, ""),
        "processes": row.processes,
        **{name: _share(one) for name, one in usages.items()},
        **{f"{name}_share": round(one.usage, 2) for name, one in usages.items()},
        **{f"{name}_limit": round(one.limit, 2) for name, one in usages.items()},
        "labels": ", ".join(f"{key}={value}" for key, value in row.description.labels.items()),
        "devices": free_devices(row.devices),
        "more": ", ".join(others),
    }


def _share(resource: ResourceRow) -> str:
    text = f"{percent(resource.usage)} % of {percent(resource.limit)} %"
    return f"{text} (old)" if resource.stale else text


def process_row(row: ProcessRow) -> Row:
    """Return the row of a process."""
    return {
        "id": row.name,
        "process": row.name,
        "state": words(row.state),
        "style": PROCESS_TROUBLE.get(row.state, ""),
        "host": row.host,
        **usage_cells(row.cpu, row.memory),
        "restarts": row.restarts or "",
        "why": first_line(row.reason),
    }


def usage_cells(cpu: float, memory: int) -> Row:
    """Return the cells of CPU and memory; `bytes` is for sorting."""
    return {
        "cpu": f"{cpu:.2f}" if cpu else "",
        "memory": size(memory) if memory else "",
        "bytes": float(f"{memory:.3g}"),
    }


def event_rows(events: Iterable[EventRow], newest: int) -> dict[str, Row]:
    """Return the rows of the newest events, by their ids."""
    return {str(row.sequence): _event(row) for row in list(events)[-newest:]}


def _event(row: EventRow) -> Row:
    return {
        "id": str(row.sequence),
        "sequence": row.sequence,
        "time": row.wall_time,
        "kind": row.kind,
        "process": row.process,
        "host": row.host,
        "message": first_line(row.message),
    }


def problems(listing: Listing) -> list[Problem]:
    """Return what is wrong, hosts first."""
    tables = (
        ("hosts", _HOST_TROUBLE, [row.state for row in listing.hosts], "host", "hosts"),
        ("processes", PROCESS_TROUBLE, [row.state for row in listing.processes],
         "process", "processes"),
    )  # fmt: skip
    return [
        Problem(table, state, f"{counted(number, one, many)} {words(state)}")
        for table, bad, states, one, many in tables
        for state in bad
        if (number := states.count(state))
    ]
