"""A process on two hosts that is moved to and fro while somebody is struck."""

from __future__ import annotations

import os
import signal
from pathlib import Path

from rosrm.config.settings import LivenessSettings
from rosrm.model.rows import ProcessRow
from rosrm.model.values import MigrationPolicy, ProcessSpec, RestartPolicy
from tests.faults.watching import Blow, Watcher, blocks, instances, is_gapless
from tests.ros.clusters import PATIENCE, QUICK, Cluster, host

ROOT = Path(__file__).resolve().parents[2]
NAME = "moving"
PROGRAMS = "benchmarks.handoff_nodes"
RATE = 50.0
#: Outputs of one instance alone after which it is taken for the active one.
_ALONE = 10
_OTHER = {"h0": "h1", "h1": "h0"}


def all_of(*blows: Blow) -> Blow:
    """One after the other."""

    def fall() -> None:
        for blow in blows:
            blow()

    return fall


class Scene:
    """The process, its cluster, and who listens.

    Whom a blow may fall on: "master", "source", "destination", "source's slave", "destination's
    slave".

    Args:
        make: makes a cluster.
        program: of `benchmarks.handoff_nodes`.
        inputs: how many it is given a second.
        module: that runs the program.
        options: of the strategy.
    """

    def __init__(
        self, make, program: str, inputs: float = 0.0, module: str = PROGRAMS, **options
    ) -> None:
        self.cluster: Cluster = make(host("h0"), host("h1"), liveness=LivenessSettings())
        self.watcher = Watcher(self.cluster.domain, inputs)
        self._source = self._pid = 0
        self._host = ""
        self._begun = 0
        self.cluster.submit(
            ProcessSpec(
                NAME, module=module,
                arguments=(program, "--rate", str(RATE)),
                environment={"PYTHONPATH": str(ROOT)}, ros=True, stop=QUICK,
                restart=RestartPolicy("on-failure", delay=0.2, attempts=100),
                migration=MigrationPolicy("handoff", options=options),
            )
        )  # fmt: skip

    def close(self) -> None:
        self.watcher.close()

    # --- the move --------------------------------------------------------------------------

    def move(self, *blows: tuple[str, Blow]) -> None:
        """Begin to move the process once it is in order, and strike at these words."""
        row = self.settle()
        self.cluster.wait_for_hosts()
        self._source, self._host = row.number, row.host
        self._pid = instances(self.cluster, NAME)[row.number]
        self._begun = self.cluster.client.list().last_sequence
        self.watcher.strike_at(self._source, *blows)
        self.cluster.client.migrate(NAME, _OTHER[row.host])
        assert self.watcher.struck.wait(PATIENCE), self._why_not_struck(blows)

    def _why_not_struck(self, blows: tuple[tuple[str, Blow], ...]) -> str:
        """What nobody said, what was said instead, and what the instances wrote."""
        logs = sorted(self.cluster.directory.glob(f"hosts/*/supervisor/logs/{NAME}.*.log"))
        newest = sorted(logs, key=lambda path: int(path.suffixes[-2][1:]))[-2:]
        wrote = [f"{path.name}: {path.read_text(errors='replace')[-2000:]!r}" for path in newest]
        words = ", ".join(word for word, _ in blows)
        return "\n".join(
            [f"of {words} not all was heard: {self.watcher.heard}", *wrote, self._record()]
        )

    def _record(self) -> str:
        """What the master wrote of it."""
        return self.cluster.log_of("master")[-3000:]

    def settle(self) -> ProcessRow:
        """Wait until one instance owns the name, alone is heard and alone is there."""
        self.cluster.wait(NAME, "running")
        before = len(self.watcher.outputs)  # what was heard until now may be of who is silent now

        def settled(view) -> bool:
            row = next(row for row in view.processes if row.name == NAME)
            last = self.watcher.outputs[before:][-_ALONE:]
            heard = len(last) == _ALONE and {one.instance for one in last} == {row.number}
            alone = instances(self.cluster, NAME).keys() == {row.number}
            return row.state == "running" and heard and alone

        view = self.cluster.wait_until("one active instance", settled, PATIENCE)
        return next(row for row in view.processes if row.name == NAME)

    def end(self, *victims: str) -> str:
        """Start again what a service manager would; how the move has ended: "moved", "stayed".

        It has ended, once; one instance is active, and no two were at any time.
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
            self.cluster.master.process.wait(PATIENCE)
            self.cluster.reconnect()
            self.cluster.start_master()
        elif victim.endswith("slave"):
            name = self._host_of(victim)
            self.cluster.slaves[name].process.wait(PATIENCE)
            self.cluster.start_slave_again(name)

    # --- blows -----------------------------------------------------------------------------

    def kill(self, victim: str) -> Blow:
        """It ends at once."""
        return lambda: self._send(victim, signal.SIGKILL)

    def hold(self, victim: str) -> Blow:
        """It does nothing more until it goes on."""
        return lambda: self._send(victim, signal.SIGSTOP)

    def let_go(self, victim: str) -> Blow:
        """It goes on."""
        return lambda: self._send(victim, signal.SIGCONT)

    def leave_alone(self) -> None:
        """No blow falls."""

    def source_held(self) -> list[tuple[str, Blow]]:
        """Blows that hold the source when the destination is READY, before the master knows it."""
        ready = all_of(self.hold("source"), self.let_go("master"))
        return [("SHADOWING", self.hold("master")), ("READY", ready)]

    def _send(self, victim: str, number: int) -> None:
        pid = self._pid_of(victim)
        assert pid > 1, f"there is no {victim}"
        os.kill(pid, number)

    def _host_of(self, victim: str) -> str:
        return self._host if victim.startswith("source") else _OTHER[self._host]

    def _pid_of(self, victim: str) -> int:
        if victim == "master":
            return self.cluster.master.process.pid
        if victim.endswith("slave"):
            return self.cluster.slaves[self._host_of(victim)].process.pid
        # Not looked for among all processes: that takes so long that the moment is over.
        return self._pid if victim == "source" else self.watcher.destination_pid

    # --- what was heard --------------------------------------------------------------------

    @property
    def outputs(self):
        """Since the move began."""
        return self.watcher.outputs

    def is_gapless(self) -> bool:
        """Nothing was lost or repeated, and nobody spoke in between."""
        return is_gapless(self.outputs) and len(blocks(self.outputs)) <= 2
