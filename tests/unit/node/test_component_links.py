"""Links of a container to components that are processes."""

from __future__ import annotations

import os
import resource
import socket
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any

from rosrm.component import link
from rosrm.node import component_links
from rosrm.node.component_links import ComponentLinks
from tests.waiting import wait_until


def connected(name: str) -> socket.socket:
    """Return a connection to a container, which may begin to listen later."""
    connection = socket.socket(socket.AF_UNIX)
    connection.settimeout(20.0)
    listens = threading.Event()
    for _ in range(400):
        try:
            connection.connect(link.address(name, os.environ))
        except ConnectionRefusedError:
            listens.wait(0.05)
        else:
            return connection
    raise AssertionError(f"{name} did not listen within 20 s")


def is_closed_by_container(connection: socket.socket) -> bool:
    """Send what is no request, and return True if the container closes the link."""
    with connection:
        connection.sendall(b"no request\n")
        return not connection.recv(1)


def lowest_free_descriptor() -> int:
    descriptor = os.open(os.devnull, os.O_RDONLY)
    os.close(descriptor)
    return descriptor


def test_a_container_without_a_free_descriptor_takes_links_again_later(tmp_path):
    """Its nodes have many files; a component that comes at a bad moment is not the last one."""
    name, failed = str(tmp_path), threading.Event()
    log = SimpleNamespace(error=lambda _: failed.set())
    ComponentLinks(name, executor=None, make=lambda *_: None, log=log)
    assert is_closed_by_container(connected(name))
    with socket.socket(socket.AF_UNIX) as early:
        soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
        resource.setrlimit(resource.RLIMIT_NOFILE, (lowest_free_descriptor(), hard))
        try:
            early.connect(link.address(name, os.environ))
            assert failed.wait(20.0), "no failure of the container within 20 s"
        finally:
            resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    assert is_closed_by_container(connected(name))


def test_a_component_that_cannot_be_destroyed_does_not_end_its_container(tmp_path):
    """The error is logged; otherwise it would end the executor, which serves the other nodes."""
    name, errors = str(tmp_path), []
    node = SimpleNamespace(destroy_node=lambda: 1 / 0)
    with ThreadPoolExecutor() as threads:
        executor = SimpleNamespace(
            create_task=threads.submit, add_node=lambda _: None, remove_node=lambda _: None
        )
        ComponentLinks(name, executor, lambda *_: node, SimpleNamespace(error=errors.append))
        with connected(name) as connection:
            link.send(connection, {"environment": {}, "plugin": "m:Node", "arguments": []})
            assert link.receive(connection) == {"pid": os.getpid(), "fault": ""}
        wait_until(lambda: errors, "the error of the component is logged")
    assert errors == ["cannot destroy a component: ZeroDivisionError: division by zero"]


@contextmanager
def container(name: str, make: Callable[..., object], errors: list[str]) -> Iterator[Any]:
    """Run a container with an executor of one thread."""
    with ThreadPoolExecutor(1) as threads:
        executor = SimpleNamespace(
            create_task=threads.submit, add_node=lambda _: None, remove_node=lambda _: None
        )
        yield executor, ComponentLinks(name, executor, make, SimpleNamespace(error=errors.append))


REQUEST = {"environment": {}, "plugin": "m:Node", "arguments": []}


def test_a_component_that_exits_in_its_constructor_ends_no_other(tmp_path):
    """`sys.exit` in a constructor is a fault of this component, like any other exception."""
    errors: list[str] = []
    with container(str(tmp_path), lambda *_: sys.exit("no map"), errors):
        for _ in range(2):
            with connected(str(tmp_path)) as connection:
                link.send(connection, REQUEST)
                fault = {"pid": os.getpid(), "fault": "SystemExit: no map"}
                assert link.receive(connection) == fault


def test_the_error_of_a_component_is_made_printable(tmp_path):
    """The log of rclpy refuses another text, and the refusal would end the container."""
    errors: list[str] = []

    def make(*_: object) -> object:
        raise ValueError("cannot read map-\udcff.pgm")

    name = str(tmp_path)
    with container(name, make, errors), connected(name) as connection:
        link.send(connection, REQUEST)
        fault = link.receive(connection)["fault"]
    assert fault == "ValueError: cannot read map-?.pgm"
    assert errors == [f"cannot load a component: {fault}"]


def test_a_container_without_a_further_thread_says_so(tmp_path, monkeypatch):
    """Otherwise the process would report that its container has ended."""
    errors: list[str] = []
    with container(str(tmp_path), lambda *_: None, errors):
        assert is_closed_by_container(connected(str(tmp_path)))

        def refused(*_, **__):
            raise RuntimeError("can't start new thread")

        monkeypatch.setattr(component_links.threads, "start", refused)
        with connected(str(tmp_path)) as connection:
            assert link.receive(connection)["fault"] == "can't start new thread"
    assert errors == ["a component cannot be loaded now: can't start new thread"]


def test_no_node_is_made_for_a_process_that_has_ended(tmp_path):
    """The executor was busy; the process was fenced, so another instance may be active."""
    errors: list[str] = []
    made: list[str] = []
    busy, ended = threading.Event(), threading.Event()
    with container(str(tmp_path), lambda *_: made.append("node"), errors) as (executor, _):
        executor.create_task(lambda: (busy.set(), ended.wait(20.0)))
        assert busy.wait(20.0)
        with connected(str(tmp_path)) as connection:
            link.send(connection, REQUEST)
        ended.set()
        wait_until(lambda: errors, "the refusal")
    assert made == []


def test_a_node_that_cannot_be_destroyed_keeps_no_other_from_its_end(tmp_path):
    """Each node stores its last state at its end."""
    destroyed: list[int] = []
    errors: list[str] = []
    with container(str(tmp_path), lambda *_: None, errors) as (_, links):
        links.nodes += [
            SimpleNamespace(destroy_node=lambda: 1 / 0),
            SimpleNamespace(destroy_node=lambda: destroyed.append(1)),
        ]
        links.close()
    assert destroyed == [1]
