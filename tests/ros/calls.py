"""Answers to single service calls, for the protocol tests."""

from __future__ import annotations

from typing import Any

from rosrm.ros.master_connection import wait_until
from rosrm.ros.participant import Participant


def answer_to(participant: Participant, future: Any, deadline: float) -> Any:
    """Return the result of a call; None when `deadline` (monotonic seconds) has passed."""
    return future.result() if wait_until(participant, future.done, deadline) else None
