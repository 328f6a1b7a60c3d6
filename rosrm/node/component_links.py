"""Links of a container to components that are processes of their own (decision 0068).

A thread for each link waits for the end of the process; the executor makes and destroys the nodes.
"""

from __future__ import annotations

import gc
import os
import select
import signal
import socket
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from typing import Any, Final

from rclpy.node import Node

from rosrm import clocks, threads
from rosrm.component import link
from rosrm.errors import describe_fault
from rosrm.node.identity import made_for
from rosrm.node.migratable import restore_now
from rosrm.runtime.signalling import send
from rosrm.wording import reason_of

#: Makes a node by the name of its component and its command line; raises what the component raises.
Make = Callable[[str, Sequence[str]], Node]
#: Seconds between two attempts to bind the address, or to accept a link.
_RETRY: Final = 0.2
#: Seconds after the end of a process in which its node must be destroyed: another instance may be
#: active elsewhere, because the process was fenced.
_PATIENCE: Final = 2.0
_LOOK: Final = 0.02


#: What the constructor of a component may raise: `sys.exit` in it ends no other component.
FAULTS: Final = (Exception, SystemExit)


class ComponentLinks:
    """Components of a container that are processes.

    Args:
        name: of the container on its host.
        executor: executes the callbacks of the nodes, and their making and end.
        make: makes a node.
        log: of the container.
    """

    def __init__(self, name: str, executor: Any, make: Make, log: Any) -> None:
        self._name = name
        self._executor = executor
        self._make = make
        self._log = log
        self.nodes: list[Node] = []
        threads.start(self._listen, "links", again=True)

    def close(self) -> None:
        """Destroy all nodes; their processes end with this one."""
        for node in self.nodes:
            destroy(node, self._log.error)

    def _listen(self) -> None:
        """Accept links, once an earlier container of the same name has released the address."""
        where = link.address(self._name, os.environ)
        with socket.socket(socket.AF_UNIX) as listening:
            while not _is_bound(listening, where):
                self._log.warning(
                    f"another container {self._name!r} runs on this host; components that are "
                    "processes are loaded when it has ended", once=True,
                )  # fmt: skip
                time.sleep(_RETRY)
            listening.listen()
            while True:
                self._accept(listening)

    def _accept(self, listening: socket.socket) -> None:
        """Serve the next link; without a free descriptor it waits for one."""
        try:
            connection, _ = listening.accept()
        except OSError as error:
            self._log.error(f"a component cannot be loaded now: {reason_of(error)}")
            time.sleep(_RETRY)
            return
        try:
            threads.start(partial(self._serve, connection), "link")
        except RuntimeError as error:  # too many threads
            self._log.error(f"a component cannot be loaded now: {error}")
            with connection, suppress(OSError):  # the process was killed
                link.send(connection, {"pid": os.getpid(), "fault": str(error)})

    def _serve(self, connection: socket.socket) -> None:
        """Make the node of a process, and destroy it when the process asks for that or ends."""
        with connection:
            request = link.receive(connection) if link.is_own(connection) else None
            if request is None:
                return
            made: list[Node] = []
            fault = self._run(lambda: made.append(self._made(request, connection)))
            try:
                link.send(connection, {"pid": os.getpid(), "fault": fault})
                connection.recv(1)
            except OSError:
                pass  # the process was killed
            if made:
                self._end(connection, made[0])

    def _made(self, request: dict[str, Any], connection: socket.socket) -> Node:
        if _is_gone(connection):  # the executor was busy; another instance may be active by now
            raise ProcessLookupError("its process has ended")
        with made_for(request["environment"]):
            node = self._make(str(request["plugin"]), list(request["arguments"]))
        try:
            restore_now(node)
            self._executor.add_node(node)
        except BaseException:  # otherwise an interrupt leaves a node that no list has
            destroy(node, self._log.error)
            raise
        self.nodes.append(node)
        return node

    def _end(self, connection: socket.socket, node: Node) -> None:
        """Destroy a node; end this container if a callback outlasts the process for too long."""
        ended = self._executor.create_task(self._destroy, node)
        killed_at = None
        while not ended.done():
            time.sleep(_LOOK)
            if killed_at is None and _is_gone(connection):
                killed_at = clocks.boot_time()
            if killed_at is not None and clocks.boot_time() - killed_at > _PATIENCE:
                send(os.getpid(), signal.SIGKILL)

    def _destroy(self, node: Node) -> None:
        """Destroy a node, in the executor."""
        self.nodes.remove(node)
        self._executor.remove_node(node)
        destroy(node, self._log.error)

    def _run(self, work: Callable[[], None]) -> str:
        """Run a function in the executor; return the error that it raised, "": none."""
        done = threading.Event()
        faults: list[str] = []

        def call() -> None:
            try:
                work()
            except FAULTS as error:
                faults.append(describe_fault(error))
            if faults:
                self._log.error(f"cannot load a component: {faults[0]}")
                gc.collect()  # a node whose constructor raised is in the graph until it is freed
            done.set()

        self._executor.create_task(call)
        done.wait()
        return "".join(faults)


def destroy(node: Node, report: Callable[[str], object]) -> None:
    """Destroy a node; its error ends neither the executor nor the end of the other nodes."""
    try:
        node.destroy_node()
    except FAULTS as error:
        report(f"cannot destroy a component: {describe_fault(error)}")


def _is_bound(listening: socket.socket, where: str) -> bool:
    try:
        listening.bind(where)
    except OSError:
        return False
    return True


def _is_gone(connection: socket.socket) -> bool:
    """Return True if the process has closed both halves, so it has ended."""
    look = select.poll()
    look.register(connection, 0)  # of a closed connection the kernel reports POLLHUP anyway
    return bool(look.poll(0))
