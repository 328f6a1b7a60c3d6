"""The page: its header, its tabs, and its connection to the cluster."""

from __future__ import annotations

import logging
from functools import partial
from typing import TYPE_CHECKING, Any, Final

from fastapi import Depends, Request
from fastapi.middleware.gzip import GZipMiddleware
from nicegui import Client, ui
from nicegui import app as nicegui_app

from rosrm_web.master_link import Busy
from rosrm_web.page import dialogs, rows, timeline_view, views
from rosrm_web.page.applications import Applications
from rosrm_web.page.live import Live
from rosrm_web.page.processes import Processes
from rosrm_web.page.timeline_feed import Feed
from rosrm_web.page.tree import Choice
from rosrm_web.page.utilities import UTILITIES

if TYPE_CHECKING:
    from fastapi import FastAPI
    from nicegui.events import ValueChangeEventArguments
    from starlette.types import ASGIApp

    from rosrm_web.access import Access
    from rosrm_web.gateway import Gateway

#: Highest number of pages at the same time.
MOST_PAGES: Final = 32
#: Seconds after which a page without a browser may be closed to make room for another page.
_UNUSED: Final = 5.0
#: Seconds after which the page of an absent browser is dropped. A browser that returns earlier, for
#: example to its Wi-Fi, keeps its open dialogs and gets all changes.
_ABSENCE: Final = 30.0
#: NiceGUI sends a ping after 0.8 of these seconds, and a browser answers within 0.4 of them.
_PINGS: Final = 15.0
#: Events in the table.
_SHOWN_EVENTS: Final = 200

_STYLE: Final = """
:root { --rosrm-bar: #9fc5e8; --rosrm-over: #f4a6a6; }
.body--dark { --rosrm-bar: #1f4e79; --rosrm-over: #7f1d1d; }
.rosrm-grid { height: calc(100vh - 13rem); min-height: 16rem; }
.rosrm-tools ~ .rosrm-grid { height: calc(100vh - 17rem); }
.nicegui-content .rosrm-half { height: calc(50vh - 9rem); margin-bottom: 0.5rem; }
.rosrm-work {
  color: inherit; background: transparent; font-family: monospace; border: 1px solid;
  padding: 0.5rem;
}
.rosrm-mark { display: inline-block; width: 1.2em; cursor: pointer; }
.rosrm-bad { color: #b00020; font-weight: 700; }
.rosrm-poor { color: #8a5a00; font-weight: 700; }
.q-loading-bar { display: none; }
.q-dialog__backdrop { z-index: 0; }
.q-dialog__inner { z-index: 1; }
.body--dark .rosrm-bad { color: #ff8a80; }
.body--dark .rosrm-poor { color: #ffd180; }
"""


_log = logging.getLogger("rosrm.web")


def mount(app: FastAPI, gateway: Gateway, access: Access) -> None:
    """Add the page to the application of the gateway, at `/`."""
    live, feed = Live(gateway), Feed(gateway)
    nicegui_app.config.socket_io_js_transports = ["websocket"]  # polling would send POST requests

    async def check_room(request: Request) -> None:  # FastAPI resolves no annotations of a partial
        _check_room(live, access, request)

    room = [Depends(check_room)]
    page = ui.page("/", title="rosrm", dark=None, reconnect_timeout=_ABSENCE, dependencies=room)
    page(partial(_page, gateway, access, live, feed))
    ui.run_with(
        app, show_welcome_message=False, language="en-US", reconnect_timeout=_PINGS,
        gzip_middleware_factory=_quickly,
        tailwind=False,  # `UTILITIES` replaces it
    )  # fmt: skip


def _quickly(app: ASGIApp) -> GZipMiddleware:
    """Compress answers by a fast level: the highest one takes ten times as long."""
    return GZipMiddleware(app, compresslevel=1)


def _check_room(live: Live, access: Access, request: Request) -> None:
    """Refuse one more page; raises `Busy`."""
    access.check_room(request.scope["user"])
    if len(live.on_change) >= MOST_PAGES:
        Client.prune_instances(client_age_threshold=_UNUSED)
    if len(live.on_change) >= MOST_PAGES:
        raise Busy(f"{MOST_PAGES} pages are open already; close one, or try again later")


def _page(gateway: Gateway, access: Access, live: Live, feed: Feed) -> None:
    client = ui.context.client
    request = client.request
    user, may_act = request.scope["user"], bool(request.scope["may_act"])
    page = Page(gateway, live, feed, user=user.name, may_act=may_act)
    client.on_delete(page.leave)
    # A browser would come back to its page with the former rights.
    client.on_delete(access.open(user, client.delete))
    live.join(page.update)
    page.update()


class Page:
    """The page of one browser.

    Args:
        gateway: sends the requests.
        live: has the newest listing.
        feed: has the events of the timeline.
        user: name of the user, for the log.
        may_act: the user is an operator, and the gateway acts.
    """

    def __init__(
        self, gateway: Gateway, live: Live, feed: Feed, *, user: str, may_act: bool
    ) -> None:  # fmt: skip
        self._gateway, self._live, self._user = gateway, live, user
        ui.add_css(UTILITIES + _STYLE + timeline_view.STYLE)
        ui.colors(primary="#1b4f8a", negative="#b00020")
        self._header(may_act=may_act)
        of_process, of_host = (dialogs.OF_PROCESS, dialogs.OF_HOST) if may_act else ((), ())
        self._process = dialogs.ProcessDialog(gateway, of_process, self._acted)
        self._host = dialogs.HostDialog(gateway, of_host, self._acted, live)
        with ui.tabs(on_change=self._show_tab).classes("max-w-full") as self._tabs:
            for name in ("hosts", "processes", "timeline", "applications", "events"):
                ui.tab(name, name.capitalize()).props("no-caps")
        panels = ui.tab_panels(self._tabs, value="hosts", keep_alive=True, animated=False)
        with panels.classes("w-full"):
            with ui.tab_panel("hosts").classes("p-0"):
                self._hosts = views.Table(views.HOSTS, "Hosts", self._host.open)
            with ui.tab_panel("processes").classes("p-0"):
                self._processes = Processes(self._process.open)
            with ui.tab_panel("timeline").classes("p-0"):
                self._timeline = timeline_view.Timeline(feed, live, self._process.open)
                self._tabs.on_value_change(self._show_timeline)
            with ui.tab_panel("applications").classes("p-0"):
                self._applications = Applications(gateway, self._acted, may_act=may_act)
            with ui.tab_panel("events").classes("p-0"):
                self._events = views.Table(views.EVENTS, "Events")
        self._problems: list[rows.Problem] = []

    def _header(self, *, may_act: bool) -> None:
        with ui.header().classes("items-center"):
            ui.label("rosrm").classes("text-h6").props("role=heading aria-level=1")
            self._state = ui.label().props("role=status aria-live=polite")
            ui.space()
            ui.label("operator" if may_act else "read-only")
        self._announcement = ui.label().classes("sr-only").props("role=status")
        self._strip = ui.row().classes("w-full").props('role=region aria-label="Problems"')

    def _acted(self, action: str) -> None:
        _log.info("%s: page: %s", self._user, action)
        self._live.wake()

    def _show_tab(self) -> None:
        if self._tabs.value == "applications":
            self._live.readers_of_applications.add(self.update)
            self._live.wake()
        else:
            self._live.readers_of_applications.discard(self.update)

    def update(self) -> None:
        """Show the newest listing and events."""
        master = self._gateway.watcher.master
        self._state.text = f"master: {master.reason or 'up'}"
        listing = self._live.listing
        if listing is None:
            return
        self._hosts.show(rows.host_rows(listing.hosts))
        self._processes.show(listing.processes)
        if self._live.applications is not None:
            self._applications.show(self._live.applications)
        self._events.show(rows.event_rows(self._live.events, _SHOWN_EVENTS))
        self._timeline.update()
        found = rows.problems(listing)
        if found != self._problems:
            self._show_problems(found)

    def _show_timeline(self, tab: ValueChangeEventArguments[Any]) -> None:
        self._timeline.show(is_shown=tab.value == "timeline")

    def _show_problems(self, found: list[rows.Problem]) -> None:
        self._problems = found
        self._strip.clear()
        self._announcement.text = f"Problems: {', '.join(one.text for one in found) or 'none'}"
        with self._strip:
            for problem in found:
                button = ui.button(problem.text, on_click=partial(self._filter, problem))
                button.props("color=negative dense no-caps").classes("px-2")
            if found:
                ui.button("Show all", on_click=self._show_all).props("dense no-caps")

    def _filter(self, problem: rows.Problem) -> None:
        self._tabs.value = problem.table
        if problem.table == "hosts":
            self._hosts.narrow(state=problem.state)
        else:
            self._processes.choose(Choice(problem.state))

    def _show_all(self) -> None:
        self._hosts.narrow()
        self._processes.choose(Choice())

    def leave(self) -> None:
        """End the updates of this browser."""
        self._live.leave(self.update)
        self._process.stop()
