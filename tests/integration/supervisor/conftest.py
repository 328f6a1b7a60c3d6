"""A supervisor in a test's own folder; no process outlives the test."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from rosrm.model.values import (
    Amendment,
    InstanceId,
    InstanceState,
    Limits,
    RestartPolicy,
    StopPolicy,
)
from rosrm.supervisor import instance_record, procfs
from rosrm.supervisor.client import SupervisorClient, log_path
from rosrm.supervisor.client_values import Amended, LaunchOrder, key_of, restart_rule, run_limits
from rosrm.supervisor.messages import Amend
from tests.waiting import PATIENCE, command_of, wait_gone

QUICK = StopPolicy(interrupt_grace=0.3, terminate_grace=0.3)


def kill(*pids: int) -> None:
    """Kill processes with SIGKILL, and wait for their ends."""
    for pid in pids:
        os.kill(pid, signal.SIGKILL)
        wait_gone(pid)


class Host:
    """One state directory with its supervisor, and the operations that tests need."""

    def __init__(self, state: Path):
        self.state = state
        self.clients: list[SupervisorClient] = []
        self.pids: set[int] = set()

    def connect(self, **options) -> SupervisorClient:
        client = SupervisorClient.connect(self.state, **options)
        self.clients.append(client)
        self.pids.add(client.pid)
        return client

    def order(self, name: str, *argv: str, number: int = 1, **options) -> LaunchOrder:
        options.setdefault("environment", dict(os.environ))
        options.setdefault("stop", QUICK)
        return LaunchOrder(InstanceId(name, number), argv, **options)

    def python(self, name: str, code: str, **options) -> LaunchOrder:
        return self.order(name, sys.executable, "-I", "-S", "-c", code, **options)

    def log(self, name: str, number: int = 1) -> Path:
        return log_path(self.state, InstanceId(name, number))

    def wait(self, client, name: str, *states: InstanceState, number: int = 1):
        """Return the first status of an instance in one of the given states."""
        instance, deadline = InstanceId(name, number), time.monotonic() + PATIENCE
        seen = []
        while time.monotonic() < deadline:
            for status in client.receive(deadline - time.monotonic()):
                seen.append(status)
                if isinstance(status, Amended):
                    continue
                if status.instance == instance and status.state in states:
                    return status
        pytest.fail(f"{instance} was in none of {states} within {PATIENCE} s; reported: {seen}")

    def sleeper(self, client, name: str, **options) -> int:
        """Start a process that sleeps; return its pid once it runs."""
        client.start([self.order(name, "sleep", "1000", **options)])
        return self.running(client, name).pid

    def run(self, client, order: LaunchOrder):
        """Start an order and return its final status."""
        client.start([order])
        return self.ended(client, order.instance.process, number=order.instance.number)

    def running(self, client, name: str, number: int = 1):
        return self.wait(client, name, InstanceState.RUNNING, number=number)

    def ended(self, client, name: str, number: int = 1):
        final = tuple(state for state in InstanceState if state.ended)
        return self.wait(client, name, *final, number=number)

    def ended_after_connect(self, client, name: str):
        """Return the final status of an instance, which may have ended before the connection."""
        found = next(one for one in client.instances if one.instance.process == name)
        return found if found.state.ended else self.ended(client, name)

    def amend(self, client, name: str, restart: RestartPolicy, limits: Limits | None = None) -> str:
        """Change an instance as the slave does; return why the supervisor refused, "": it did not.

        Waits for the supervisor's record.
        """
        instance, deadline = InstanceId(name, 1), time.monotonic() + PATIENCE
        rules = restart_rule(restart), {"ROSRM_SHADOW": None}, run_limits(limits)
        client.send(Amend(key_of(instance), *rules))
        amendment = Amendment(restart, limits)
        while time.monotonic() < deadline:
            for one in client.receive(max(0.0, deadline - time.monotonic())):
                if isinstance(one, Amended) and one.amendment == amendment:
                    return one.refusal
        raise AssertionError(f"{amendment} was not reported within {PATIENCE} s")

    def kill_supervisor(self, client) -> None:
        kill(client.pid)
        client.close()

    def replace_supervisor(self, client) -> SupervisorClient:
        """Kill the supervisor with SIGKILL; return the connection to the next one."""
        self.kill_supervisor(client)
        return self.connect()

    def reconnect(self, client) -> SupervisorClient:
        """Close a connection, and return another one."""
        client.close()
        return self.connect()

    def rewrite(self, change: Callable[[dict], object]) -> None:
        """Change each line of the record, as another version or another boot would have left it."""
        path = self.state / "instances.jsonl"
        lines = [json.loads(line) for line in path.read_text().splitlines()]
        for line in lines:
            change(line)
        path.write_text("".join(json.dumps(line) + "\n" for line in lines))

    def cut_record(self, *, after_spawn: bool) -> None:
        """End the record behind the note of its last spawn, or before that note."""
        path = self.state / "instances.jsonl"
        lines = path.read_text().splitlines(keepends=True)
        last = max(i for i, line in enumerate(lines) if '"record":"spawning"' in line)
        path.write_text("".join(lines[: last + after_spawn]))

    def alive(self) -> list[int]:
        """Return the pids of all processes of the supervisor and their descendants."""
        found = procfs.find_marked(str(self.state))
        return [stat.pid for stats in found.values() for stat in stats]

    def clean_up(self) -> None:
        for client in self.clients:
            client.close()
        lock = self.state / "supervisor.lock"
        if lock.exists():
            self.pids.add(int(lock.read_text() or 0))
        for pid in self.pids:
            if str(self.state) in command_of(pid):
                kill(pid)
        for pid in {*self.recorded(), *self.alive()}:
            with contextlib.suppress(ProcessLookupError):  # it may end just now
                os.kill(pid, signal.SIGKILL)

    def recorded(self) -> list[int]:
        """Return living leaders from the record: during its exec a leader shows no marks yet."""
        recorded = instance_record.read(str(self.state))
        leaders = []
        for key, instance in recorded.instances.items():
            stat = procfs.read_stat(instance.pid) if instance.pid else None
            if stat is not None and procfs.was_born(stat, recorded.births[key]):
                leaders.append(instance.pid)
        return leaders


@pytest.fixture
def host(tmp_path):
    host = Host(tmp_path / "state")
    yield host
    host.clean_up()


@pytest.fixture
def client(host):
    return host.connect()
