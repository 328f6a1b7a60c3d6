"""Ending what a slave that is gone left running on its host."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Final

from rosrm.core.model import InstanceId, InstanceStatus
from rosrm.errors import RosrmError
from rosrm.spelling import counted, listed
from rosrm.state_directory import only_one
from rosrm.supervisor.client import SupervisorClient, SupervisorEnded

#: Seconds for all processes to end: longer than any sensible `stop` of a process.
_LONGEST: Final = 600.0


def stop_all(state: Path, longest: float = _LONGEST) -> str:
    """Stop every process that a former slave left with its supervisor, then the supervisor.

    Args:
        state: the slave's state directory.
        longest: seconds to wait for the processes to end.

    Returns:
        What was stopped, for the user.

    Raises:
        Refused: a slave runs on this state directory.
        SupervisorError: the supervisor does not answer.
        RosrmError: processes have not ended in time.
    """
    if not (state / "supervisor").is_dir():
        return f"nothing to stop: no slave was started with the state directory {state}"
    with (
        only_one(state, "slave", code="name_taken", remedy="another `--config`"),
        # Where the supervisor was killed, another one takes over what it left.
        SupervisorClient.connect(state / "supervisor") as client,
    ):
        live = {one.instance for one in client.instances if not one.state.ended}
        client.shutdown()
        return _await_end(client, set(live), len(live), time.monotonic() + longest)


def _await_end(client: SupervisorClient, live: set[InstanceId], count: int, deadline: float) -> str:
    while (left := deadline - time.monotonic()) > 0.0:
        try:
            told = client.receive(left)
        except SupervisorEnded:
            return f"{counted(count, 'process', 'processes')} stopped; the supervisor has ended"
        live -= {
            one.instance for one in told if isinstance(one, InstanceStatus) and one.state.ended
        }
    named = listed(sorted(map(str, live)) or ["the supervisor"])
    raise RosrmError(f"not ended in time: {named}; supervisor pid {client.pid} still stops them")
