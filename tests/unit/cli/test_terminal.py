"""The terminal of `rosrm top`."""

from __future__ import annotations

import os
import pty

import pytest

from rosrm.cli.output.terminal import Terminal


def test_a_terminal_that_has_gone_does_not_replace_the_end_of_the_view():
    """After the window was closed, the exit code is that of the signal."""
    master, slave = pty.openpty()

    def view():
        with os.fdopen(slave, "r") as keys, Terminal(keys):
            os.close(master)
            raise SystemExit(129)

    with pytest.raises(SystemExit) as ended:
        view()
    assert ended.value.code == 129
