"""Output of `rosrm status`: an overview of the cluster on half a page."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence

from rich.console import Group, RenderableType
from rich.styled import Styled
from rich.text import Text

from rosrm.cli.output import tables
from rosrm.model.rows import HostRow, Listing, PluginRow, ProcessRow
from rosrm.wording import duration, words

#: States of a process that need an operator's attention.
_TROUBLE = ("stuck", "unreachable", "unknown", "failed", "set_aside", "backoff")
_MOST_NAMED = 5


def render(snapshot: Listing, to_leave: Sequence[str] = ()) -> RenderableType:
    """Return the overview of a listing with hosts, processes and the newest events.

    Args:
        to_leave: sentences on the hosts that processes have to leave.
    """
    return Group(*_lines(snapshot, to_leave))


def _lines(snapshot: Listing, to_leave: Sequence[str]) -> Iterator[RenderableType]:
    yield Text(f"master     {snapshot.master}, up {duration(snapshot.uptime)}")
    if snapshot.security == "none":
        yield Text(
            "security   none: every participant of this ROS domain has all rights", style="red"
        )
    if snapshot.strangers:
        yield Text(f"strangers  {snapshot.strangers}", style="yellow")
    yield Text(f"hosts      {_counted(row.state for row in snapshot.hosts)}{_set(snapshot.hosts)}")
    yield Text(f"processes  {_counted(row.state for row in snapshot.processes)}")
    if snapshot.hosts:
        yield Text()
        yield tables.hosts(snapshot.hosts)
    yield from _first([Text(one, style="yellow") for one in to_leave], "rosrm hosts")
    yield from _first(list(_troubles(snapshot.processes)), "rosrm ps")
    yield from _first(list(_failing(snapshot.plugins)), "rosrm plugins")
    if snapshot.events:
        yield Text()
        yield from (Styled(tables.event(event), "dim") for event in snapshot.events)


def _counted(states: Iterable[str]) -> str:
    counts = Counter(states)
    return ", ".join(f"{n} {words(word)}" for word, n in counts.most_common()) or "none"


def _set(hosts: Iterable[HostRow]) -> str:
    rows = list(hosts)
    drained = sum(row.drained for row in rows)
    draining = sum(row.draining and not row.drained for row in rows)
    cordoned = sum(row.cordoned and not row.draining for row in rows)
    parts = [
        f"{n} {word}"
        for n, word in ((cordoned, "cordoned"), (draining, "draining"), (drained, "drained"))
        if n
    ]
    return f" ({', '.join(parts)})" if parts else ""


def _troubles(processes: Iterable[ProcessRow]) -> Iterator[Text]:
    rows = [row for row in processes if row.state in _TROUBLE]
    for row in sorted(rows, key=lambda row: _TROUBLE.index(row.state)):
        text = tables.sentence(row.name, row.state)
        yield text.append(f": {row.reason}" if row.reason else "")


def _failing(plugins: Iterable[PluginRow]) -> Iterator[Text]:
    for row in plugins:
        place = f" on {row.host}" if row.host else ""
        text = Text(f"plugin {row.kind} {row.name}{place} is ")
        yield text.append_text(tables.state(row.state)).append(f": {row.reason}")


def _first(lines: Sequence[Text], command: str) -> Iterator[Text]:
    """Return a paragraph with the first lines, and the command that shows the others."""
    if lines:
        yield Text()
    yield from lines[:_MOST_NAMED]
    if len(lines) > _MOST_NAMED:
        yield Text(f"and {len(lines) - _MOST_NAMED} more; see {command}")
