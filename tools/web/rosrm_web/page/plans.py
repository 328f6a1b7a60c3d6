"""Plans of changes: their actions with reasons, and the button that applies them."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any, Final, Protocol

from nicegui import ui

from rosrm.cli.output import applications
from rosrm.cli.planned import as_planned
from rosrm.errors import ConfigError, RosrmError
from rosrm.model.applications import ApplicationRow, ApplyResult, Target
from rosrm.wording import listed
from rosrm_web.acting import checked_work_file, require_application
from rosrm_web.page.dialogs import Question, heading, show_table
from rosrm_web.page.plan_rows import interruptions, summary

if TYPE_CHECKING:
    from rosrm.client.client import Client
    from rosrm_web.gateway import Gateway

#: Characters of a work file; a message of a browser has at most 256 KiB.
LONGEST_WORK: Final = 64_000
_ACTION: Final = ("action", "process", "host", "why")
_VERSION: Final = ("version", "requested", "by", "processes", "note")
#: Sends the text of an element, or its length if that is too large.
_SEND: Final = """() => {{
  const text = getHtmlElement({element}).value;
  emit(text.length > {longest} ? text.length : text);
}}"""
#: Copies a file into an element; of a large one only a part, which is refused later.
_LOAD: Final = """async (event) => {{
  const file = event.target.files[0];
  if (file) getHtmlElement({element}).value = await file.slice(0, {longest} * 4).text();
}}"""


class Request(Protocol):
    """A request for a change of applications."""

    def __call__(self, client: Client, *, plan_only: bool = False) -> ApplyResult:
        """Make the request, or return its plan."""


class Plan:
    """A part of a dialog that shows a plan, and lets the operator apply it.

    Args:
        gateway: sends the requests.
        on_action: called with a description of a change, after it has begun.
    """

    def __init__(self, gateway: Gateway, on_action: Callable[[str], None]) -> None:
        self._gateway, self._on_action = gateway, on_action
        self._question = Question()
        self._area = ui.column().classes("w-full").props("aria-live=polite")

    def clear(self) -> None:
        """Show nothing."""
        self._area.clear()

    def refuse(self, error: Exception) -> None:
        """Show an error in place of a plan."""
        self._area.clear()
        with self._area:
            ui.label(str(error)).classes("rosrm-bad whitespace-pre-line").props("role=alert")

    async def show(self, request: Request) -> None:
        """Ask for a plan, and show it."""
        self.clear()
        try:
            plan = await self._ask(partial(request, plan_only=True))
        except RosrmError as error:
            self.refuse(error)
            return
        self._area.clear()
        with self._area:
            ui.label(plan.message)
            if plan.actions:
                show_table(_ACTION, map(applications.action_cells, plan.actions), "Plan")
                begin = partial(self._begin, request, plan)
                ui.button(f"Apply: {summary(plan.actions)}", on_click=begin).props("no-caps")

    async def _begin(self, request: Request, plan: ApplyResult) -> None:
        """Make a request if its plan still holds."""
        effect = interruptions(plan.actions)
        if effect and not await self._question.ask(effect, f"Apply: {summary(plan.actions)}"):
            return
        notes: list[str] = []
        try:
            done = await self._ask(
                lambda client: as_planned(plan, partial(request, client), notes.append)()
            )
        except RosrmError as error:
            self.refuse(error)
            return
        self._area.clear()
        with self._area:
            for text in (f"Accepted: {done.message}", *notes):
                ui.label(text).props("role=status")
        names = listed(dict.fromkeys(one.application for one in plan.actions))
        self._on_action(f"{summary(plan.actions)} of {names}")

    async def _ask(self, request: Callable[[Client], ApplyResult]) -> ApplyResult:
        return await self._gateway.ask(self._gateway.acting, request)


class _ChangeDialog:
    """A dialog with a title, a part of its own, and a plan."""

    def __init__(self, gateway: Gateway, on_action: Callable[[str], None]) -> None:
        with ui.dialog() as self.dialog, ui.card().classes("w-full max-w-screen-lg"):
            with heading(self.dialog) as self.title:
                pass  # no further buttons
            self.body = ui.column().classes("w-full")
            self.plan = Plan(gateway, on_action)


class WorkDialog(_ChangeDialog):
    """The plan of a work file that the operator pastes or loads."""

    def __init__(self, gateway: Gateway, on_action: Callable[[str], None]) -> None:
        super().__init__(gateway, on_action)
        self.title.text = "Plan of a change"
        with self.body:
            area = ui.element("textarea").classes("w-full rosrm-work")
            area.props('aria-label="Work file" rows=12 spellcheck=false')
            sizes = {"element": area.id, "longest": LONGEST_WORK}
            with ui.row().classes("w-full items-center"):
                ui.element("input").props(
                    'type=file accept=".yaml,.yml" aria-label="Load a work file"'
                ).on("change", js_handler=_LOAD.format(**sizes))
                ui.button("Plan").props("no-caps").on(
                    "click", self._show_plan, js_handler=_SEND.format(**sizes)
                )

    def open(self) -> None:
        """Show the dialog."""
        self.plan.clear()
        self.dialog.open()

    async def _show_plan(self, event: Any) -> None:
        loop = asyncio.get_running_loop()
        try:
            target = await loop.run_in_executor(None, _target_of, event.args)
        except ConfigError as error:
            self.plan.refuse(error)
            return
        await self.plan.show(partial(_apply, target=target))


class ApplicationDialog(_ChangeDialog):
    """The versions of an application; operators may revert to one, or cancel the application."""

    def __init__(
        self, gateway: Gateway, on_action: Callable[[str], None], *, may_act: bool
    ) -> None:  # fmt: skip
        super().__init__(gateway, on_action)
        self._may_act = may_act

    def open(self, row: ApplicationRow) -> None:
        """Show an application."""
        self.title.text = row.name
        self.plan.clear()
        self.body.clear()
        with self.body:
            show_table(_VERSION, applications.version_cells(row), "Versions")
            if self._may_act:
                self._show_buttons(row)
        self.dialog.open()

    def _show_buttons(self, row: ApplicationRow) -> None:
        requests: list[tuple[str, Request]] = [
            (f"Revert to version {one.number}", partial(_revert, name=row.name, to=one.number))
            for one in reversed(row.versions)
            if not one.wanted
        ]
        if row.version:
            requests.append(("Cancel", partial(_apply, target=Target(row.name))))
        with ui.row():
            for title, request in requests:
                ui.button(
                    f"Plan: {title}", color=None, on_click=partial(self.plan.show, request)
                ).props("outline no-caps")  # fmt: skip


class ModeDialog(_ChangeDialog):
    """The plan of a switch to a mode."""

    async def open(self, name: str) -> None:
        """Show a mode."""
        self.title.text = f"Switch to the mode {name}"
        self.plan.clear()
        self.dialog.open()
        await self.plan.show(partial(_switch, name=name))


def _apply(client: Client, *, target: Target, plan_only: bool = False) -> ApplyResult:
    return client.apply_targets([target], plan_only=plan_only)


def _revert(client: Client, *, name: str, to: int, plan_only: bool = False) -> ApplyResult:
    return client.revert(name, to, plan_only=plan_only)


def _switch(client: Client, *, name: str, plan_only: bool = False) -> ApplyResult:
    return client.switch_mode(name, plan_only=plan_only)


def _target_of(given: object) -> Target:
    """Return the application of a work file, as a browser has sent it."""
    if not isinstance(given, str) or len(given) > LONGEST_WORK:
        length = len(given) if isinstance(given, str) else given
        raise ConfigError(
            f"work: {length} characters; the page takes at most {LONGEST_WORK}. Use `rosrm apply`"
        )
    target = checked_work_file(given.encode(), is_json=False)
    return require_application(target, "`rosrm submit`")
