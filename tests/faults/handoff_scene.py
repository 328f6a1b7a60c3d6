"""Migrations of one process between two hosts while a participant is killed or paused."""

from __future__ import annotations

import contextlib
import os
import signal
from pathlib import Path

from rosrm.config.settings import LivenessSettings
from rosrm.model.rows import ProcessRow
from rosrm.model.values import MigrationPolicy, ProcessSpec, RestartPolicy
from tests.faults.handoff_watcher import Fault, Watcher, answered_by, blocks, instances, is_gapless
from tests.ros.clusters import QUICK, Cluster, host
from tests.waiting import PATIENCE, wait_until

ROOT = Path(__file__).resolve().parents[2]
NAME = "moving"
COUNT = "benchmarks.handoff_nodes"
RATE = 50.0
#: Consecutive outputs of one instance after which that instance counts as the active one.
_ALONE = 10
#: Seconds for one active instance. On a busy machine a step may take its whole `ready_timeout`,
#: 30 s, before the migration is undone.
_SETTLED = 2 * PATIENCE
_OTHER = {"h0": "h1", "h1": "h0"}


def all_of(*faults: Fault) -> Fault:
    """Return one fault that consists of several, in this order."""

    def fall() -> None:
        for fault in faults:
            fault()

    return fall


class Scene:
    """A cluster with one process, and a watcher of its handoffs.

    Possible victims of a fault: "master", "source", "destination", "source's slave", "destination's
    slave".

    Args:
        make: function that creates a cluster.
        module: Python module that runs the program `count` of `benchmarks.handoff_nodes`.
        inputs: inputs per second that the watcher publishes to the process.
        options: options of the migration strategy.
    """

    def __init__(self, make, module: str = COUNT, *, inputs: float = 0.0, **options) -> None:
        self.cluster: Cluster = make(host("h0"), host("h1"), liveness=LivenessSettings())
        self.watcher = Watcher(self.cluster.domain, ("h0", "h1"), inputs)
        wait_until(lambda: len(self.watcher.slaves()) == 2, "the watcher discovers the slaves")
        self._source = self._pid = 0
        self._host = ""
        self._begun = 0
        self.cluster.submit(
            ProcessSpec(
                NAME, module=module,
                arguments=("count", "--rate", str(RATE)),
                environment={"PYTHONPATH": str(ROOT)}, ros=True, stop=QUICK,
                restart=RestartPolicy("on-failure", delay=0.2, attempts=100),
                migration=MigrationPolicy("handoff", options=options),
            )
        )  # fmt: skip

    def close(self) -> None:
        self.watcher.close()

    # --- the migration ---------------------------------------------------------------------

    def move(self, *faults: tuple[str, Fault]) -> None:
        """Wait for one active instance, start its migration, and inject the faults."""
        row = self.settle()
        self.cluster.wait_for_hosts()
        self._source, self._host = row.number, row.host
        self._pid = instances(self.cluster, NAME)[row.number]
        self._begun = self.cluster.client.list().last_sequence
        self.watcher.inject_at(self._source, *faults)
        self.cluster.client.migrate(NAME, _OTHER[row.host])
        assert self.watcher.injected.wait(PATIENCE), self._why_not_injected(faults)

    def _why_not_injected(self, faults: tuple[tuple[str, Fault], ...]) -> str:
        """Describe the missing reports, the received ones, and the newest logs of the instances."""
        logs = sorted(self.cluster.directory.glob(f"hosts/*/supervisor/logs/{NAME}.*.log"))
        newest = sorted(logs, key=lambda path: int(path.suffixes[-2][1:]))[-2:]
        wrote = [f"{path.name}: {path.read_text(errors='replace')[-2000:]!r}" for path in newest]
        words = ", ".join(word for word, _ in faults)
        return "\n".join(
            [f"of {words} not all was heard: {self.watcher.heard}", *wrote, self._record()]
        )

    def _record(self) -> str:
        """Return the end of the master's log."""
        return self.cluster.log_of("master")[-3000:]

    def settle(self) -> ProcessRow:
        """Wait until exactly one instance runs, owns the name, publishes, and answers inputs."""
        self.cluster.wait(NAME, "running", timeout=_SETTLED)
        # An older output may be from an instance that is silent by now.
        before = len(self.watcher.outputs)

        def settled(view) -> bool:
            row = next(row for row in view.processes if row.name == NAME)
            last = self.watcher.outputs[before:][-_ALONE:]
            heard = len(last) == _ALONE and {one.instance for one in last} == {row.number}
            alone = instances(self.cluster, NAME).keys() == {row.number}
            return row.state == "running" and heard and alone and bool(answered_by(last))

        view = self.cluster.wait_until("one active instance", settled, _SETTLED)
        return next(row for row in view.processes if row.name == NAME)

    def end(self, *victims: str) -> str:
        """Restart each victim as a service manager would, and return "moved" or "stayed".

        The migration must end exactly once. One instance is active afterwards, and at no time were
        two.
        """
        for victim in victims:
            self._start_again(victim)
        row = self.settle()
        events = self.cluster.events(process=NAME, after=self._begun)
        ends = [event.kind for event in events if event.kind in ("migrated", "stayed")]
        assert len(ends) == 1, (ends, self._record())
        assert len(blocks(self.outputs)) <= 3, blocks(self.outputs)
        if ends == ["migrated"]:
            assert row.number > self._source
        return "moved" if ends == ["migrated"] else "stayed"

    def _start_again(self, victim: str) -> None:
        if victim == "master":
            self.cluster.restart_master()
        elif victim.endswith("slave"):
            known = self.watcher.slaves()
            self.cluster.start_slave_again(self._host_of(victim))
            # Otherwise the watcher may miss the first status of the next migration.
            wait_until(lambda: self.watcher.slaves() - known, "the watcher discovers the slave")

    # --- faults ----------------------------------------------------------------------------

    def kill(self, victim: str) -> Fault:
        """Return a fault that kills the victim with SIGKILL."""
        return lambda: self._send(victim, signal.SIGKILL)

    def hold(self, victim: str) -> Fault:
        """Return a fault that pauses the victim with SIGSTOP."""
        return lambda: self._send(victim, signal.SIGSTOP)

    def let_go(self, victim: str) -> Fault:
        """Return a fault that resumes the victim with SIGCONT."""
        return lambda: self._send(victim, signal.SIGCONT)

    def leave_alone(self) -> None:
        """Inject nothing."""

    def source_held(self) -> list[tuple[str, Fault]]:
        """Return faults that pause the source at the destination's READY, unseen by the master."""
        ready = all_of(self.hold("source"), self.let_go("master"))
        return [("SHADOWING", self.hold("master")), ("READY", ready)]

    def _send(self, victim: str, number: int) -> None:
        pid = self._pid_of(victim)
        assert pid > 1, f"there is no {victim}"
        with contextlib.suppress(ProcessLookupError):  # a released source may have ended already
            os.kill(pid, number)

    def _host_of(self, victim: str) -> str:
        return self._host if victim.startswith("source") else _OTHER[self._host]

    def _pid_of(self, victim: str) -> int:
        if victim == "master":
            return self.cluster.master.process.pid
        if victim.endswith("slave"):
            return self.cluster.slaves[self._host_of(victim)].process.pid
        # The pid is recorded beforehand: a scan of all processes would miss the moment.
        return self._pid if victim == "source" else self.watcher.destination_pid

    # --- received outputs ------------------------------------------------------------------

    @property
    def outputs(self):
        """Outputs since the start of the migration."""
        return self.watcher.outputs

    def is_gapless(self) -> bool:
        """Return True if no output or input is lost or repeated, and the instances took turns."""
        return is_gapless(self.outputs) and len(blocks(self.outputs)) <= 2
