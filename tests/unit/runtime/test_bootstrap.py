"""Log lines of the runtimes."""

from __future__ import annotations

import logging

from rosrm.runtime.bootstrap import LogFormatter


def formatted(message: str, **more) -> str:
    record = logging.LogRecord("rosrm.master", logging.INFO, "", 1, message, (), **more)
    return LogFormatter("%(name)s: %(message)s").format(record)


def test_a_log_line_shows_control_characters_as_numbers():
    """A name in a message must not rename the window of who reads the log."""
    line = formatted("a\x1b]0;x\x07\x9b", exc_info=None)
    assert line == r"rosrm.master: a\x1b]0;x\x07\x9b"


def test_a_message_cannot_look_like_two_log_lines():
    line = formatted("p\nrosrm.master: master stopped", exc_info=None)
    assert line == "rosrm.master: p\n    rosrm.master: master stopped"


def test_a_traceback_keeps_its_lines():
    try:
        int("\x1b[2J")
    except ValueError as fault:
        line = formatted("failed", exc_info=(type(fault), fault, fault.__traceback__))
    assert line.splitlines()[1] == "Traceback (most recent call last):"
    assert r"\x1b[2J" in line.splitlines()[-1]
