"""Dialogs of the page: a process with its explanation and logs, a host, and actions on both."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, Final

from nicegui import background_tasks, ui

from rosrm.cli.output import explain
from rosrm.client.logs import LogSelection
from rosrm.errors import RosrmError
from rosrm.model.values import EMPTY
from rosrm.wording import duration, listed, percent

if TYPE_CHECKING:
    from rosrm.client.client import Client
    from rosrm.client.logs import LogReader
    from rosrm.model.rows import DeviceRow
    from rosrm_web.gateway import Gateway
    from rosrm_web.page.live import Live

#: Last lines of a log that are shown.
_LINES: Final = 1000
#: Seconds between two requests for new output.
_PERIOD: Final = 1.0
_SCORES: Final = ("host", "verdict", "score", "why")


@dataclass(frozen=True)
class Action:
    """Something that an operator may do.

    Attributes:
        title: text of the button.
        warning: effect of the action, shown for confirmation before it begins.
        request: to the master, with the name of the process or host, and the chosen host ("": any);
            returns its message.
        only_if: part of `possible` in an explanation, without which there is no button; "": none.
        to_host: the user may choose a host for it.
    """

    title: str
    warning: str
    request: Callable[[Client, str, str], str]
    only_if: str = ""
    to_host: bool = False


OF_PROCESS: Final = (
    Action("Restart", "{name} is stopped and started again.", lambda c, name, _: c.restart([name])),
    Action(
        "Move", "{name} moves to another host.",
        lambda c, name, host: c.migrate(name, host or None), to_host=True,
    ),
    Action(
        "Checkpoint", "{name} is written to an image on its host, and ends until it is restored.",
        lambda c, name, _: c.checkpoint(name), only_if="checkpoint",
    ),
    Action(
        "Restore", "{name} continues from its image, on the host of the image.",
        lambda c, name, _: c.restore(name), only_if="restore",
    ),
    Action("Cancel", "{name} is stopped for good.", lambda c, name, _: c.cancel([name])),
)  # fmt: skip
OF_HOST: Final = (
    Action("Cordon", "{name} gets no new processes.", lambda c, name, _: c.cordon(name)),
    Action("Uncordon", "{name} gets new processes again.", lambda c, name, _: c.uncordon(name)),
    Action(
        "Drain", "{name} gets no new processes, and those that can leave it move away.",
        lambda c, name, _: c.drain(name),
    ),
)  # fmt: skip


class Dialog:
    """A dialog about one process or host, with buttons for operators.

    Args:
        gateway: sends the requests.
        actions: buttons; (): the user may not act.
        on_action: called with a description of an action, after it was requested.
    """

    def __init__(
        self, gateway: Gateway, actions: Sequence[Action], on_action: Callable[[str], None]
    ) -> None:
        self._gateway, self._on_action = gateway, on_action
        self.name = ""
        self._possible: Mapping[str, Any] = EMPTY
        self._optional: dict[str, ui.button] = {}
        with ui.dialog() as self.dialog:
            self.card = ui.card().classes("w-full max-w-screen-lg")
        self._question = Question()
        with self.card, heading(self.dialog) as self._title:
            for action in actions:
                button = ui.button(
                    action.title, color=None, on_click=partial(self._confirm, action)
                ).props("outline no-caps")  # fmt: skip
                if action.only_if:
                    self._optional[action.only_if] = button

    def open(self, name: str) -> None:
        """Show the process or host of this name."""
        self.name = self._title.text = name
        self.offer(EMPTY)
        self.dialog.open()

    def offer(self, possible: Mapping[str, Any]) -> None:
        """Show the buttons of what is possible now, as an explanation has it."""
        self._possible = possible
        for name, button in self._optional.items():
            button.set_visibility(bool(possible.get(name)))

    async def _confirm(self, action: Action) -> None:
        name = self.name
        hosts = ("", *self._possible.get("move", ())) if action.to_host else ()
        if not await self._question.ask(action.warning.format(name=name), action.title, hosts):
            return
        host = self._question.host
        try:
            message = await self._gateway.ask(
                self._gateway.acting, lambda client: action.request(client, name, host)
            )
            ui.notify(message)
        except RosrmError as error:
            ui.notify(str(error), type="negative", multi_line=True, close_button="Close")
        self._on_action(f"{action.title.lower()} {name}")


@contextmanager
def heading(dialog: ui.dialog) -> Iterator[ui.label]:
    """Add a row with a title that names a dialog, the buttons that the caller adds, and Close."""
    with ui.row().classes("w-full items-center"):
        title = ui.label().classes("text-h6").props("role=heading aria-level=2")
        dialog.props(f"aria-labelledby={title.html_id}")
        ui.space()
        yield title
        ui.button("Close", color=None, on_click=dialog.close).props("flat no-caps")


class Question:
    """A dialog that asks the user to confirm an action.

    Attributes:
        host: the host that the user chose last; "": any.
    """

    def __init__(self) -> None:
        self._dialog = ui.dialog()
        self.host = ""

    async def ask(self, effect: str, title: str, hosts: Sequence[str] = ()) -> bool:
        """Return True if the user confirms an action with this effect; offer a choice of hosts."""
        question = self._dialog
        if question.value:
            return False  # a second press, before the browser shows the question
        question.clear()
        with question, ui.card():
            question.props(f"aria-labelledby={ui.label(effect).html_id}")
            self.host = ""
            if hosts:
                names = {host: host or "any host" for host in hosts}
                ui.select(names, label="To", value="").bind_value_to(self, "host")
            with ui.row():
                ui.button(title, on_click=lambda: question.submit(True)).props("no-caps")
                ui.button("Do nothing", color=None, on_click=question.close).props("flat no-caps")
        return bool(await question)


class HostDialog(Dialog):
    """The labels and devices of a host.

    Args:
        gateway: sends the requests.
        actions: buttons; (): the user may not act.
        on_action: as of `Dialog`.
        live: has the newest listing.
    """

    def __init__(
        self, gateway: Gateway, actions: Sequence[Action], on_action: Callable[[str], None],
        live: Live,
    ) -> None:  # fmt: skip
        super().__init__(gateway, actions, on_action)
        self._live = live
        with self.card:
            self._body = ui.column().classes("w-full")

    def open(self, name: str) -> None:
        """Show the host of this name."""
        super().open(name)
        self._body.clear()
        listing = self._live.listing
        hosts = listing.hosts if listing is not None else ()
        row = next((one for one in hosts if one.description.name == name), None)
        if row is not None:
            with self._body:
                labels = [f"{key}={value}" for key, value in row.description.labels.items()]
                ui.label(f"Labels: {', '.join(labels) or 'none'}")
                show_table(("device", "state", "about"), map(_device, row.devices), "Devices")


def _device(row: DeviceRow) -> tuple[str, str, str]:
    """Return title, state and description of a device."""
    held = f"held by {listed(row.holders)}" if row.holders else ""
    free = "free" if row.free >= 1.0 else f"{percent(row.free)} % free" if row.free > 0.0 else ""
    missing = f"missing: {row.missing}" if row.missing else ""
    state = missing or ", ".join(filter(None, (free, held)))
    return row.title, state, row.about


class ProcessDialog(Dialog):
    """The explanation and the logs of a process."""

    def __init__(
        self, gateway: Gateway, actions: Sequence[Action], on_action: Callable[[str], None]
    ) -> None:
        super().__init__(gateway, actions, on_action)
        with self.card:
            with ui.tabs() as tabs:
                ui.tab("why", "Why here").props("no-caps")
                ui.tab("logs", "Logs").props("no-caps")
            with ui.tab_panels(tabs, value="why", animated=False).classes("w-full"):
                with ui.tab_panel("why"):
                    self._why = ui.column().classes("w-full")
                with ui.tab_panel("logs"):
                    self._log = _Log(gateway)
        self._explaining: asyncio.Task[None] | None = None
        self.dialog.on("hide", self.stop)

    def open(self, name: str) -> None:
        """Show the process of this name."""
        super().open(name)
        self.stop()
        self._why.clear()
        self._log.start(name)
        self._explaining = background_tasks.create(self._explain(name))

    def stop(self) -> None:
        """End all requests, also one that a slow master has not answered."""
        self._log.stop()
        if self._explaining is not None:
            self._explaining.cancel()

    async def _explain(self, name: str) -> None:
        gateway = self._gateway
        try:
            found = await gateway.ask(gateway.acting, lambda client: client.explain(name))
        except RosrmError as error:
            with self._why:
                ui.label(str(error)).classes("rosrm-bad")
            return
        self.offer(found.get("possible") or EMPTY)
        with self._why:
            _show_explanation(found)


def _show_explanation(explanation: Mapping[str, Any]) -> None:
    """Show state, decision, the table of scores, and the history of a process."""
    ui.label(explain.headline(explanation).plain).classes("whitespace-pre-line")
    decision = explanation.get("decision")
    if decision:
        ui.label(explain.sentence(explanation["process"], decision).plain)
        ui.label(explain.needs(decision.get("need") or {}).plain)
        show_table(_SCORES, explain.host_cells(decision), "Scores of the hosts, the lowest wins")
    history = (
        (duration(one["elapsed"]), one["kind"], one["message"])
        for one in explanation.get("history") or ()
    )
    show_table(("ago", "kind", "message"), history, "History")


def show_table(names: Sequence[str], lines: Iterable[Sequence[str]], title: str) -> None:
    """Show lines of text, with a cell for each name, as a small table."""
    columns = [
        {"name": name, "label": name.capitalize(), "field": name, "align": "left"} for name in names
    ]
    rows = [{**dict(zip(names, line, strict=True)), "id": str(at)} for at, line in enumerate(lines)]
    table = ui.table(columns=columns, rows=rows, row_key="id", title=title)
    table.classes("w-full").props("dense flat wrap-cells")


class _Log:
    """The output of a process, live, with a search."""

    def __init__(self, gateway: Gateway) -> None:
        self._gateway = gateway
        self._lines: deque[str] = deque(maxlen=_LINES)
        self._reader: LogReader | None = None
        self._opening: asyncio.Task[None] | None = None
        self._search = ui.input("Show only lines with", on_change=self._show).props(
            "dense clearable"
        )
        self._text = ui.log(max_lines=_LINES).classes("w-full h-96")
        self._timer = ui.timer(_PERIOD, self._poll, active=False)

    def start(self, process: str) -> None:
        """Show the output of a process from now on."""
        self._lines.clear()
        self._text.clear()
        self._opening = background_tasks.create(self._begin(process))

    def stop(self) -> None:
        """Read no more output."""
        self._timer.deactivate()
        self._reader = None
        if self._opening is not None:
            self._opening.cancel()

    async def _begin(self, process: str) -> None:
        try:
            self._reader, content = await self._gateway.ask(
                self._gateway.logs, partial(_open_log, process=process, gateway=self._gateway)
            )
        except RosrmError as error:
            self._add(str(error))
            return
        self._add(content)
        self._timer.activate()

    async def _poll(self) -> None:
        reader = self._reader
        if reader is None or reader.at_end:
            return
        try:
            chunk = await self._gateway.ask(self._gateway.logs, lambda _: reader.poll())
        except RosrmError:
            return  # the header says that the master is lost; the next request may succeed
        if reader is self._reader and chunk is not None and chunk.content:
            self._add(chunk.content.decode(errors="replace"))

    def _add(self, text: str) -> None:
        lines = text.splitlines()
        self._lines.extend(lines)
        for line in self._matching(lines):
            self._text.push(line)

    def _show(self) -> None:
        self._text.clear()
        for line in self._matching(self._lines):
            self._text.push(line)

    def _matching(self, lines: Sequence[str] | deque[str]) -> list[str]:
        wanted = self._search.value or ""
        return [line for line in lines if wanted in line]


def _open_log(client: Client, process: str, gateway: Gateway) -> tuple[LogReader, str]:
    """Return a reader and the last lines, below sentences about parts that are not live."""
    selection = LogSelection(_LINES, follow=True)
    (reader,) = client.log_readers([process], selection, gateway.open_archive())
    text = b"".join(chunk.content for chunk in reader.read())
    notes = [f"--- {note}\n" for note in gateway.logs.notes]
    return reader, "".join(notes) + text.decode(errors="replace")
