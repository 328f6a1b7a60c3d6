"""Deadline of plugin calls: a hanging plugin is interrupted, named, and skipped for a while."""

from __future__ import annotations

import contextlib
import re
import sys
import time

import pytest

from rosrm.errors import PluginError
from rosrm.extensions.plugin_calls import PluginCalls
from rosrm.extensions.plugin_deadline import Deadlines

SLOW = ("migration", "slow")


def deadlines(**options):
    return Deadlines(**{"seconds": 0.1, "pause": 0.3, **options})


def spin():
    while True:
        pass


def swallow():
    """Catch the first interrupt and continue."""
    for _ in range(3):
        with contextlib.suppress(Exception):
            spin()
    spin()


def work():
    return sum(range(1000))


def catch_everything():
    """Catch every interrupt, and continue."""
    while True:
        try:  # noqa: SIM105 - as a careless plugin does
            work()
        except BaseException:  # noqa: BLE001
            pass


def catch_everything_twice():
    """Call a loop that catches every interrupt in another one."""
    while True:
        try:  # noqa: SIM105
            catch_everything()
        except BaseException:  # noqa: BLE001
            pass


def catch_and_answer():
    """Answer late, after an interrupt."""
    try:
        spin()
    except BaseException:  # noqa: BLE001
        return "scores"


def test_one_that_answers_is_passed_on() -> None:
    """The caller gets its answer or error, and no alarm follows."""
    ask = deadlines()
    assert ask(SLOW, lambda: "scores") == "scores"
    with pytest.raises(ZeroDivisionError):
        ask(SLOW, lambda: 1 / 0)
    time.sleep(0.15)


@pytest.mark.timeout(60)
@pytest.mark.parametrize(
    "act",
    [
        spin,
        lambda: time.sleep(100),
        swallow,
        catch_everything,
        catch_everything_twice,
        catch_and_answer,
    ],
)
def test_one_that_hangs_is_ended(act) -> None:
    """The deadline also ends a plugin that sleeps or swallows the error."""
    ask = deadlines()
    began = time.monotonic()
    with pytest.raises(TimeoutError, match=r"longer than 0\.1 s"):
        ask(SLOW, act)
    assert time.monotonic() - began < 30.0
    time.sleep(0.15)  # no alarm is left


def test_one_that_hung_is_left_alone_for_a_while() -> None:
    """The plugin costs its deadline once, not once for every reading."""
    ask, asked = deadlines(pause=1.0), []

    def hangs():
        asked.append(1)
        spin()

    with pytest.raises(TimeoutError, match="not asked again"):
        ask(SLOW, hangs)
    for _ in range(4):
        with pytest.raises(PluginError, match="not asked again"):
            ask(SLOW, hangs)
    assert len(asked) == 1
    time.sleep(1.05)
    assert ask(SLOW, lambda: "scores") == "scores"


def test_each_plugin_has_its_own_deadline() -> None:
    """A late plugin neither excludes another one nor disables its deadline."""
    ask = deadlines(pause=30.0)
    for late in (("scoring", "a"), ("checkpoint", "b"), ("migration", "a")):
        with pytest.raises(TimeoutError):
            ask(late, spin)
        assert ask(("scoring", "good"), lambda: "choice") == "choice"


def test_the_place_at_which_a_plugin_hung_is_reported_also_in_the_pause() -> None:
    """The first message and the later ones have the plugin's own line."""
    calls = PluginCalls(deadlines(pause=30.0))
    first = spin.__code__.co_firstlineno
    place = rf"test_plugin_deadline\.py:({first + 1}|{first + 2})\)"
    for _ in range(2):
        with pytest.raises(PluginError, match=place):
            calls.ask(*SLOW, "propose", spin)


def test_a_plugin_cannot_end_the_master_by_an_interrupt() -> None:
    """In a master Ctrl-C raises nothing, so a KeyboardInterrupt is the plugin's."""

    def interrupts():
        raise KeyboardInterrupt("mine")

    with pytest.raises(PluginError, match="KeyboardInterrupt: mine"):
        deadlines()(SLOW, interrupts)


@pytest.mark.timeout(60)
def test_a_plugin_that_catches_its_interrupt_is_logged_with_its_place(caplog) -> None:
    """The log has the file and line where an overdue plugin still runs."""
    with pytest.raises(TimeoutError):
        deadlines()(SLOW, catch_everything)
    assert "catches its interrupt" in caplog.text
    assert re.search(r"test_plugin_deadline\.py:\d+", caplog.text)


def test_the_trace_function_of_a_debugger_is_kept() -> None:
    """After the interrupt of a plugin the process has its own trace function again."""
    before = sys.gettrace(), sys.getprofile()
    with pytest.raises(TimeoutError):
        deadlines()(SLOW, catch_everything)
    assert (sys.gettrace(), sys.getprofile()) == before
