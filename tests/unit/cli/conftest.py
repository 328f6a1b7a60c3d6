"""Fixtures: the command line with a fake client."""

from __future__ import annotations

from dataclasses import dataclass, field
from types import SimpleNamespace

import pytest
from typer.testing import CliRunner

from rosrm.cli import connection
from rosrm.cli.command_tree import app
from rosrm.errors import Refused
from rosrm.model.rows import (
    HOST_MARK,
    EventRow,
    HostRow,
    Listing,
    PluginRow,
    ProcessRow,
    ResourceRow,
)
from rosrm.model.values import HostDescription

NAN = float("nan")


def resource(name, usage=0.4, in_flight=0.1, limit=0.8, stale=False):
    return ResourceRow(name, "B", 2e9, "machine", usage, in_flight, limit, stale)


def host(
    name, state="up", *, cordoned=False, draining=False, resources=None, processes=2, drained=False
):
    rows = (resource("memory"), resource("cpu", 0.95, 0.0, 0.9)) if resources is None else resources
    description = HostDescription(name, 7, labels={"gpu": "true"})
    return HostRow(
        description, 3, state, cordoned, draining, True, 0.05, tuple(rows), processes, drained
    )


def process(name, state="running", host="alpha", *, number=1, kind="service", **more):
    values = {
        "pid": 99 if state == "running" else 0, "restarts": 0, "migrations": 0, "exit_code": 0,
        "priority": 0, "queue_position": 0, "since": 12.0, "cpu": 0.5, "memory": 64_000_000,
        "reason": "", **more,
    }  # fmt: skip
    return ProcessRow(name=name, kind=kind, state=state, host=host, number=number, **values)


def event(sequence, kind="assigned", process="talker", host="alpha", message=""):
    text = message or f"{process} goes to {host}"
    return EventRow(sequence, 1_700_000_000.0, 1.5, kind, process, host, text, {"score": 0.4})


HOSTS = [host("alpha"), host("beta", "suspect", cordoned=True), host("gamma", draining=True)]
PROCESSES = [
    process("talker", restarts=2, migrations=1),
    process("next", "queued", "", queue_position=1, reason="no host has room: memory"),
    process("crashed", "failed", kind="job", exit_code=3),
    process("done", "finished", kind="job"),
]
PLUGINS = [
    PluginRow("scoring", "weighted", "rosrm-scoring 0.1.0", "selected", "weight x usage, summed"),
    PluginRow("probe", "gpu", "rosrm-resources 0.1.0", "absent", "no NVIDIA driver", "alpha"),
]
EVENTS = [event(1, "submitted", host=""), event(2)]
STORY = {
    "process": "talker", "state": "running", "host": "alpha", "reason": "",
    "decision": {
        "kind": "assigned", "elapsed": 61.0, "policy": "weighted", "chosen": "alpha",
        "need": {"memory": 64e6, "cpu": 0.5},
        "hosts": [
            {"name": "alpha", "verdict": "chosen", "score": 0.41234, "reason": "memory 0.41"},
            {"name": "beta", "verdict": "full", "score": None, "reason": "memory 0.79 of 0.8"},
            {"name": "gamma", "verdict": "vetoed", "score": None, "reason": "too near its limit"},
        ],
        "omitted": {"cannot take it now": 5, "would take it at a higher score": 0},
    },
    "history": [{"elapsed": 62.0, "kind": "submitted", "message": "talker was submitted"}],
}  # fmt: skip


@dataclass
class FakeClient:
    """Fake connection that answers like a master and records its requests."""

    hosts: list = field(default_factory=lambda: list(HOSTS))
    processes: list = field(default_factory=lambda: list(PROCESSES))
    plugins: list = field(default_factory=lambda: list(PLUGINS))
    events: list = field(default_factory=lambda: list(EVENTS))
    applications: list = field(default_factory=list)
    modes: list = field(default_factory=list)
    trouble: str = ""
    security: str = "keys"
    strangers: str = ""
    asked: list = field(default_factory=list)
    fails: BaseException | None = None
    unknown: set = field(default_factory=set)  # names of no process
    to_leave: list = field(default_factory=list)  # sentences on a host that must be left
    waits: tuple = ()  # seconds without an answer, before each listing
    settings: object = None
    closed: bool = False

    def close(self):
        self.closed = True

    def _note(self, *what):
        self.asked.append(what)
        if self.fails is not None:
            raise self.fails

    def submit(self, specs):
        self._note("submit", [spec.name for spec in specs])
        return f"{len(specs)} processes were queued"

    def cancel(self, names, *, force=False):
        self._note("cancel", list(names), *(["force"] if force else []))
        return "cancelled"

    def restart(self, names):
        self._note("restart", list(names))
        return "restarted"

    def migrate(self, name, host):
        self._note("migrate", name, host)
        return "moving"

    def checkpoint(self, name):
        self._note("checkpoint", name)
        return f"{name}: it is being checkpointed"

    def restore(self, name):
        self._note("restore", name)
        return f"{name}: it is being restored"

    def set_host_state(self, host, action):
        self._note(action, host)
        return f"{host}: {action}"

    def prune(self, processes, hosts):
        self._note("prune", list(processes), list(hosts))
        return "removed"

    def explain(self, name):
        if name.startswith(HOST_MARK):
            return {"of_host": name.removeprefix(HOST_MARK), "over": {}, "reasons": self.to_leave}
        if name in self.unknown:
            raise Refused(f"no such process: {name}", "unknown")
        self._note("explain", name)
        return STORY

    def list(self, *, hosts=False, processes=False, plugins=False, applications=False, modes=False,
             events=False, process="", host="", after=0, newest=0, on_wait=None):  # fmt: skip
        if on_wait is not None:
            for seconds in self.waits:
                on_wait(seconds)
        self._note("list", {"process": process, "host": host, "after": after, "newest": newest})
        chosen = [row for row in self.events if row.sequence > after]
        chosen = [one for one in chosen if process in ("", one.process) and host in ("", one.host)]
        return Listing(
            master="lab", uptime=125.0, trouble=self.trouble, security=self.security,
            strangers=self.strangers,
            last_sequence=max((row.sequence for row in self.events), default=0),
            hosts=self.hosts if hosts else (), processes=self.processes if processes else (),
            plugins=[row for row in self.plugins if plugins and plugins in (True, row.state)],
            applications=self.applications if applications else (),
            modes=self.modes if modes else (),
            events=chosen[-(newest or 1000) :] if events else (),
        )  # fmt: skip


@pytest.fixture
def client(monkeypatch):
    """Replace the connection of every command; the fake keeps its settings."""
    fake = FakeClient()

    def connect(settings, _security):
        fake.settings = settings
        return fake

    monkeypatch.setattr(connection, "connect", connect)
    return fake


@pytest.fixture
def while_asleep(client, monkeypatch):
    """Return a function that sets what happens in each sleep of a command, in turn.

    A step is a mapping of new values of the client, or a function.
    """

    def set_steps(*steps):
        left = list(steps)

        def sleep(seconds):
            assert left, "the command sleeps once more than expected"
            step = left.pop(0)
            step() if callable(step) else vars(client).update(step)

        monkeypatch.setattr("time.sleep", sleep)
        return left

    return set_steps


def interrupt():
    """Press Ctrl-C."""
    raise KeyboardInterrupt


@pytest.fixture
def rosrm():
    """Run one command line; return both streams and the exit code."""

    def run(*words, columns=None, charset="utf-8"):
        environment = {"COLUMNS": columns, "NO_COLOR": "1", "TERM": "dumb"}
        runner = CliRunner(charset, environment)
        result = runner.invoke(app, [str(word) for word in words], prog_name="rosrm")
        return SimpleNamespace(code=result.exit_code, out=result.stdout, err=result.stderr)

    return run
