"""`/diagnostics` where the ROS installation lacks its messages."""

from __future__ import annotations

import logging
import sys

from rosrm.ros.master.diagnostics import open_diagnostics


def test_a_ros_installation_without_the_messages_is_reported_once(monkeypatch, caplog):
    """No publisher is made, and the log names the package and the setting."""
    monkeypatch.setitem(sys.modules, "diagnostic_msgs", None)
    with caplog.at_level(logging.WARNING):
        assert open_diagnostics(None) is None
    (line,) = caplog.messages
    assert "diagnostic_msgs" in line
    assert "`diagnostics: false`" in line
