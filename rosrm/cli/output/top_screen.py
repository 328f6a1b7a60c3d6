"""Screen of `rosrm top`: repeated views of the cluster, and keyboard input."""

from __future__ import annotations

import contextlib
import itertools
import sys
import time
from collections.abc import Callable
from typing import Final

from rich.console import Console
from rich.live import Live

from rosrm import clocks
from rosrm.cli.output import tables, top
from rosrm.cli.output.terminal import Terminal
from rosrm.errors import ConfigError, NoMaster
from rosrm.model.rows import Listing
from rosrm.wording import duration

#: Shortest time between two views, in seconds.
LEAST_PERIOD: Final = 0.1
#: Sort order of each key.
KEYS: Final = {"s": "state", "c": "cpu", "m": "memory", "n": "name"}
_QUIT: Final = "q"
_HINT: Final = "q quits; sort: s state, c CPU, m memory, n name"
#: Lines beside those of hosts and processes: title (two), heads, events, hint and gaps.
_OTHER_LINES: Final = 13
_LEAST_ROWS: Final = 5
#: Seconds of a request after which the view shows that the master does not answer.
_SILENCE: Final = 1.0


def sort_of(text: str) -> str:
    """Return the option --sort; raises `ConfigError` for an unknown order."""
    if text not in top.SORTS:
        raise ConfigError(f"--sort: {text!r} is not one of {', '.join(top.SORTS)}")
    return text


def show(look: Callable[..., Listing], period: float, count: int, sort: str) -> None:
    """Show views until q or Ctrl-C, or until `count` of them; 0: no limit.

    Args:
        look: requests a listing from the master; raises `NoMaster`. Its argument `on_wait` takes
            the seconds of a wait, repeatedly.
        period: seconds between two views.
        count: number of views.
        sort: order of the processes.
    """
    console = tables.console()
    if console.is_terminal and count != 1:
        _keep_up_to_date(console, look, period, count, sort)
        return
    snapshot, note = look(), ""
    for shown in itertools.count(1):
        rows = top.ROWS if console.is_terminal else len(snapshot.processes)
        console.print(top.TopView(snapshot, rows=rows, note=note, sort=sort))
        if shown == count:
            return
        time.sleep(period)
        snapshot, note = _look_again(look, snapshot)


def _keep_up_to_date(
    console: Console, look: Callable[..., Listing], period: float, count: int, sort: str
) -> None:
    """Draw each view over the one before."""
    snapshot = look()
    with (
        Terminal(sys.stdin) as terminal,
        Live(console=console, auto_refresh=False) as screen,
        terminal.given_back(screen),
        contextlib.suppress(_Quit),
    ):
        key = terminal.key
        view = _LiveView(screen, key, snapshot, sort)
        for shown in itertools.count(1):
            view.draw()
            if shown == count:
                return
            view.await_key(period)
            view.look_again(look)


class _Quit(Exception):
    """The user has pressed q."""


class _LiveView:
    """View that is drawn again with each answer and key, and while the master is silent.

    Args:
        key: returns the key that is pressed within some seconds, or "".
    """

    def __init__(
        self, screen: Live, key: Callable[[float], str], snapshot: Listing, sort: str
    ) -> None:
        self._screen = screen
        self._key = key
        self._snapshot = snapshot
        self._sort = sort
        self._note = ""
        self._answered = clocks.boot_time()

    def draw(self) -> None:
        """Draw the newest listing."""
        console = self._screen.console
        rows = max(_LEAST_ROWS, console.height - _OTHER_LINES - len(self._snapshot.hosts))
        picture = top.TopView(
            self._snapshot, rows=rows, note=self._note, sort=self._sort, foot=_HINT
        )
        self._screen.update(picture, refresh=True)

    def await_key(self, seconds: float) -> None:
        """Wait for a key; raise `_Quit` for q."""
        pressed = self._key(seconds)
        if pressed == _QUIT:
            raise _Quit
        self._sort = KEYS.get(pressed, self._sort)

    def look_again(self, look: Callable[..., Listing]) -> None:
        """Request a listing; keep the one before if the master does not answer."""
        try:
            self._snapshot = look(on_wait=self._wait)
        except NoMaster:
            self._note = self._note or "the master does not answer"
            return
        self._note, self._answered = "", clocks.boot_time()

    def _wait(self, seconds: float) -> None:
        """Show a silence of a second or more, and react to keys."""
        before = (self._note, self._sort)
        if self._note or seconds >= _SILENCE:
            silence = duration(clocks.boot_time() - self._answered)
            self._note = f"the master has not answered for {silence}"
        self.await_key(0.0)
        if (self._note, self._sort) != before:
            self.draw()


def _look_again(look: Callable[..., Listing], before: Listing) -> tuple[Listing, str]:
    try:
        return look(), ""
    except NoMaster:
        return before, "the master does not answer"
