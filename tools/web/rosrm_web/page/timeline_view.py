"""Timeline of the page: processes over hosts, live or in a look back."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, Final

from nicegui import background_tasks, ui

from rosrm import clocks
from rosrm.wording import duration
from rosrm_web.page import timeline_chart, views
from rosrm_web.page.timeline import STYLES, Picture, View, picture

if TYPE_CHECKING:
    from nicegui.events import EChartPointClickEventArguments, GenericEventArguments

    from rosrm_web.page.live import Live
    from rosrm_web.page.timeline_feed import Feed

_WINDOWS: Final = {60.0: "1 min", 300.0: "5 min", 3600.0: "1 h", 86_400.0: "1 day"}
#: Shortest and longest window, s, of the keys + and -.
_SHORTEST, _LONGEST = 5.0, 7 * 86_400.0
#: Parts of the window by which the arrow keys shift it, and factors of its length.
_SHIFTS: Final = {"ArrowLeft": -0.25, "ArrowRight": 0.25}
_FACTORS: Final = {"+": 0.5, "=": 0.5, "-": 2.0}
_KEYS: Final = f"""(event) => {{
  if ({[*_SHIFTS, *_FACTORS]}.includes(event.key) && !event.ctrlKey && !event.metaKey) {{
    event.preventDefault();
    emit(event.key);
  }}
}}"""
#: Seconds after which states are drawn again without an event, e.g. of a host that is silent.
_OLD: Final = 5.0
STYLE: Final = f"""
.rosrm-timeline {{ height: calc(100vh - 27rem); min-height: 22rem; }}
.rosrm-marks .rosrm-grid {{ height: 14rem; min-height: 0; }}
.rosrm-chip {{ display: inline-block; width: 1rem; height: 0.8rem; border-radius: 2px; }}
{timeline_chart.style()}
"""
_MARKS: Final = (
    views.time_column(sort="desc"),
    views.column("what", width=110),
    views.column("process", width=180),
    views.column("host", width=180),
    views.column("message", flex=1, minWidth=240),
)
#: Passes on the part of the time that is visible, in percent of the window.
_ZOOM: Final = """(event) => {
    const zoom = (event.batch || [event])[0];
    if (['time', 'wheel'].includes(zoom.dataZoomId)) emit(zoom.start, zoom.end);
}"""


class Timeline:
    """The picture, its controls, and a table of the moves and faults in it.

    Args:
        feed: has the events.
        live: has the newest listing.
        on_process: called with the name of a process that the user chooses.
    """

    def __init__(self, feed: Feed, live: Live, on_process: Callable[[str], None]) -> None:
        self._feed, self._live, self._on_process = feed, live, on_process
        self._view = View(300.0)
        self._is_shown = False
        self._made = Picture()
        self._drawn: tuple[object, ...] = ()
        self._drawn_at = 0.0
        self._controls()
        self._chart = ui.echart(
            timeline_chart.options(), renderer="svg", on_point_click=self._choose
        )
        self._chart.classes("w-full rosrm-timeline").props(
            'role=application tabindex=0 aria-label="Processes over hosts. The keys + and - zoom, '
            'the arrow keys shift. A table below has its moves and faults"'
        )
        self._chart.on("keydown", lambda event: self._press(event.args), js_handler=_KEYS)
        self._chart.on("chart:datazoom", self._zoomed, js_handler=_ZOOM)
        with ui.row().classes("w-full items-center gap-x-3 gap-y-1"):
            self._summary = ui.label()
            for number, name in enumerate(STYLES):
                with ui.row().classes("items-center gap-1"):
                    ui.element("span").classes(f"rosrm-chip rosrm-bar-{number}")
                    ui.label(name)
        with ui.element().classes("w-full rosrm-marks"):
            self._marks = views.Table(_MARKS, "Moves and faults", self._choose_mark)

    def _controls(self) -> None:
        with ui.row().classes("w-full items-center gap-2"):
            self._windows = ui.toggle(
                _WINDOWS, value=self._view.seconds, on_change=self._set_window
            ).props('no-caps dense role=group aria-label="Window"')  # fmt: skip
            for title, act in (
                ("Zoom in", partial(self._zoom, 0.5)), ("Zoom out", partial(self._zoom, 2.0)),
                ("Earlier", partial(self._shift, -0.5)), ("Later", partial(self._shift, 0.5)),
                ("Now", self._follow),
            ):  # fmt: skip
                ui.button(title, on_click=act).props("dense no-caps").classes("px-2")
            self._state = ui.label("live").props("role=status")
            self._length = ui.label(duration(self._view.seconds)).props("role=status")
            self._older = ui.button("Older events", color=None, on_click=self._read_older)
            self._older.props("outline dense no-caps").classes("px-2").set_visibility(False)
            for name in ("host", "application", "process"):
                ui.input(name.capitalize(), on_change=partial(self._narrow, name)).props(
                    "dense clearable debounce=300"
                ).classes("w-32")

    # --- what the user does --------------------------------------------------------------

    def show(self, *, is_shown: bool) -> None:
        """Begin or end the drawing, because the user opens or leaves the tab."""
        self._is_shown = is_shown
        if is_shown:
            background_tasks.create(self._begin())

    async def _begin(self) -> None:
        await self._feed.read()
        self.update()

    def _set_window(self, event: Any) -> None:
        if event.value:  # otherwise `_zoom` has chosen another length
            self._look(replace(self._view, seconds=event.value))

    def _press(self, key: str) -> None:
        if key in _SHIFTS:
            self._shift(_SHIFTS[key])
        elif key in _FACTORS:
            self._zoom(_FACTORS[key])

    def _zoom(self, factor: float) -> None:
        """Change the length of the window; in a look back the middle stays."""
        view = self._view
        seconds = min(max(factor * view.seconds, _SHORTEST), _LONGEST)
        end = view.end
        if end is not None:
            now = self._feed.timeline.clock.wall_time(self._now())
            end = min(end + (seconds - view.seconds) / 2, now)
        self._look(replace(view, seconds=seconds, end=end))
        self._windows.value = seconds if seconds in _WINDOWS else None

    async def _read_older(self) -> None:
        await self._feed.read_older()
        self._draw()

    def _shift(self, share: float) -> None:
        end = self._end + share * self._view.seconds
        is_past = self._drawn and end < self._now()
        wall_time = self._feed.timeline.clock.wall_time(end)
        self._look(replace(self._view, end=wall_time if is_past else None))

    def _follow(self) -> None:
        self._look(replace(self._view, end=None))

    def _narrow(self, name: str, event: Any) -> None:
        narrowed: dict[str, Any] = {name: event.value or ""}
        self._view = replace(self._view, **narrowed)
        self._draw()

    def _zoomed(self, event: GenericEventArguments) -> None:
        """Stop following when the visible part no longer ends now."""
        _, end = event.args
        if end < 99.0 and self._view.end is None and self._drawn:
            wall_time = self._feed.timeline.clock.wall_time(self._now())
            self._view = replace(self._view, end=wall_time)
            self._show_state()

    def _look(self, view: View) -> None:
        self._view = view
        whole = {"type": "dataZoom", "dataZoomId": "time", "start": 0, "end": 100}
        self._chart.run_chart_method("dispatchAction", whole)
        self._show_state()
        self._draw()

    def _show_state(self) -> None:
        self._state.text = "live" if self._view.end is None else "looking back"
        self._length.text = duration(self._view.seconds)

    def _choose(self, event: EChartPointClickEventArguments) -> None:
        shape = event.value
        if isinstance(shape, list) and shape[4]:
            self._on_process(shape[4])

    def _choose_mark(self, key: str) -> None:
        row = self._made.table.get(key, {})
        if row.get("process"):
            self._on_process(row["process"])

    # --- what the user sees --------------------------------------------------------------

    def update(self) -> None:
        """Follow the cluster, unless the user looks back."""
        if self._is_shown and (self._view.end is None or not self._drawn):
            background_tasks.create(self._feed.read())
            self._draw()

    def _now(self) -> float:
        listing, clock = self._live.listing, self._feed.timeline.clock
        return max(clock.newest, clock.at(listing.uptime) if listing is not None else 0.0)

    @property
    def _end(self) -> float:
        end = self._view.end
        return self._now() if end is None else self._feed.timeline.clock.seconds(end)

    def _draw(self) -> None:
        """Send the picture if it has changed; otherwise only the time of its edges."""
        listing, feed = self._live.listing, self._feed
        if listing is None or not feed.newest:
            return
        edges = {
            name: round(1e3 * feed.timeline.clock.wall_time(seconds))
            for name, seconds in (("min", self._end - self._view.seconds), ("max", self._end))
        }
        self._older.set_visibility(feed.has_older)
        options = self._chart.options
        options["xAxis"].update(edges)
        basis = (self._view, feed.newest, listing.last_sequence)
        if basis == self._drawn and clocks.boot_time() - self._drawn_at < _OLD:
            made = self._made
        else:
            made = picture(feed.timeline, listing, self._view, self._now())
            self._drawn, self._drawn_at = basis, clocks.boot_time()
        if made == self._made:
            self._chart.run_chart_method("setOption", {"xAxis": edges})
            return
        self._made = made
        timeline_chart.fill(options, made)
        self._chart.update()
        self._summary.text = made.summary
        self._marks.show(made.table)
