"""Process of a component: has its node made in a container, and exists as long as the node.

python -m rosrm.component CONTAINER PLUGIN [--ros-args ...]
"""

from __future__ import annotations

import os
import signal
import socket
import sys
import time
from contextlib import suppress
from typing import Any, Final

from rosrm import clocks
from rosrm.component import link

#: Seconds in which the container must listen: it may have been started at the same time.
_PATIENCE: Final = 5.0
_PAUSE: Final = 0.05


def main(arguments: list[str]) -> str:
    """Run until the node has ended, and return why it failed; "": a signal has ended it."""
    if len(arguments) < 2 or "ROSRM_INSTANCE" not in os.environ:
        return (
            "run it as a process of rosrm, with the arguments CONTAINER PLUGIN; "
            "see docs/how-to/components.md"
        )
    container, plugin, *rest = arguments
    connection = _connected(container)
    if connection is None:
        return f"no container {container!r} runs on this host"
    stopped = []

    def stop(_number: int, _frame: Any) -> None:
        """Close this half: the container then destroys the node, and closes the other half."""
        stopped.append(True)
        with suppress(OSError):  # the container has ended
            connection.shutdown(socket.SHUT_WR)

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, stop)
    with connection:
        fault = _follow(connection, plugin, rest)
    return "" if stopped else fault or f"the container {container!r} has ended"


def _connected(container: str) -> socket.socket | None:
    """Return a connection to a container of this host; None: there is none."""
    where, until = link.address(container, os.environ), clocks.boot_time() + _PATIENCE
    while True:
        connection = socket.socket(socket.AF_UNIX)
        try:
            connection.connect(where)
        except OSError:
            connection.close()
            if clocks.boot_time() >= until:
                return None
            time.sleep(_PAUSE)
        else:
            return connection


def _follow(connection: socket.socket, plugin: str, arguments: list[str]) -> str:
    """Request the node, and wait for its end; return why the container cannot create it."""
    if not link.is_own(connection):
        return "the container belongs to another user"
    environment = {name: value for name, value in os.environ.items() if name.startswith("ROSRM_")}
    try:
        link.send(
            connection, {"plugin": plugin, "arguments": arguments, "environment": environment}
        )
        answer = link.receive(connection)
        if answer is None or answer.get("fault"):
            return "" if answer is None else f"cannot be loaded: {answer['fault']}"
        link.show_container(int(answer["pid"]))
        sys.stderr.write("the node runs, and prints, in its container\n")
        connection.recv(1)
    except ConnectionError:
        pass  # the container was killed
    return ""


if __name__ == "__main__":
    _fault = " ".join(main(sys.argv[1:]).split())
    if _fault:
        sys.stderr.write(f"{link.FAULT}{_fault}\n")
    sys.exit(link.FAILED if _fault else 0)
