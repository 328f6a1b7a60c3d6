"""Master and slave are killed while a process is checkpointed or restored.

The killed part is started again, as its service manager would do. Afterwards the process runs or is
checkpointed, the other state can be requested, and no count is missing or repeated.
"""

from __future__ import annotations

import signal
import time
from pathlib import Path

import pytest

from rosrm.config.settings import LivenessSettings, MigrationSettings, ProcessDefaults
from rosrm.errors import Refused
from rosrm_criu.engine import restore_result
from tests.faults.handoff_watcher import instances
from tests.ros.clusters import MIB, PATIENCE, host, python, wait_until

pytestmark = pytest.mark.timeout(180)

#: Files of the host that mark a moment of a checkpoint or a restore.
_SIGNS = {
    "dump": "kept-*", "kept": "kept-*/manifest.json", "taken": "in-*/manifest.json",
    "restored": f"in-*/{restore_result.FILE}",
}  # fmt: skip
_ENDS = {"checkpointed", "checkpoint_failed", "restored", "restore_failed"}


class Scene:
    """A counter with some memory, which writes each number into a file."""

    def __init__(self, make, folder: Path) -> None:
        self.numbers_file = folder / "numbers"
        self.cluster = make(
            host("robot"), liveness=LivenessSettings(),
            migration=MigrationSettings(strategies={"criu": {}}, automatic=False),
            defaults=ProcessDefaults(needs={"memory": MIB}),
        )  # fmt: skip
        code = (
            "import os, time\nheap = os.urandom(60_000_000)\nn = 0\n"
            "while True:\n    n += 1\n"
            f"    with open({str(self.numbers_file)!r}, 'a') as file:\n"
            "        file.write(f'{n}\\n')\n"
            "    time.sleep(0.01)\n"
        )
        self.cluster.submit(python("p", code))
        self.cluster.wait("p", "running")
        self.check_counts()

    @property
    def images(self) -> Path:
        return self.cluster.directory / "hosts" / "robot" / "images"

    def numbers(self) -> list[int]:
        lines = self.numbers_file.read_text().splitlines(True) if self.numbers_file.exists() else []
        return [int(line) for line in lines if line.endswith("\n")]

    def check_counts(self) -> None:
        """Check that the process counts, and that no number is missing or repeated."""
        seen = len(self.numbers())
        wait_until(lambda: len(self.numbers()) > seen + 10, "numbers")
        found = self.numbers()
        assert found == list(range(1, len(found) + 1))

    def be(self, state: str) -> None:
        """Bring the process into a state, by requests."""
        row = self.cluster.wait("p", "running", "checkpointed")
        if row.state != state:
            self.ask("checkpoint" if state == "checkpointed" else "restore")
            assert self.end() in ("checkpointed", "restored")
            self.cluster.wait("p", state)

    def ask(self, action: str) -> None:
        self._before = self.cluster.client.list().last_sequence
        deadline = time.monotonic() + PATIENCE
        while True:
            try:
                getattr(self.cluster.client, action)("p")
            except Refused as refusal:
                late = time.monotonic() > deadline
                if late or not any(one in str(refusal) for one in ("not known yet", "fit there")):
                    raise
                self.cluster.client.spin(0.1)
            else:
                return

    def await_moment(self, moment: str) -> None:
        deadline = time.monotonic() + PATIENCE
        while not any(self.images.glob(_SIGNS[moment])):
            assert time.monotonic() < deadline, f"no {moment}: {self.log()}"
            time.sleep(0.001)

    def kill(self, victim: str) -> None:
        """Kill a part by SIGKILL, and start it again as a service manager does."""
        part = self.cluster.master if victim == "master" else self.cluster.slaves["robot"]
        part.end(signal.SIGKILL)
        part.process.wait(PATIENCE)
        if victim == "master":
            self.cluster.reconnect()
            self.cluster.start_master()
        else:
            self.cluster.start_slave(self.cluster.hosts[0])

    def end(self) -> str:
        """Return the kind of the event that ended the action."""
        deadline = time.monotonic() + 120.0
        while True:
            events = self.cluster.events(process="p", after=self._before)
            ends = [event.kind for event in events if event.kind in _ENDS]
            if ends:
                return ends[-1]
            assert time.monotonic() < deadline, f"it has not ended: {self.log()}"
            self.cluster.client.spin(0.1)

    def log(self) -> str:
        return self.cluster.log_of("master")[-3000:]


@pytest.fixture(scope="module")
def scene(make_shared, tmp_path_factory):
    return Scene(make_shared, tmp_path_factory.mktemp("count"))


@pytest.mark.parametrize("victim", ["master", "slave"])
@pytest.mark.parametrize("moment", ["dump", "kept", "taken", "restored"])
def test_a_checkpoint_or_restore_survives_the_kill_of_a_part(criu, scene, victim, moment):
    """There is one instance or one image afterwards, and the counts continue."""
    action = "checkpoint" if moment in ("dump", "kept") else "restore"
    scene.be("running" if action == "checkpoint" else "checkpointed")
    scene.ask(action)
    scene.await_moment(moment)
    scene.kill(victim)
    scene.end()
    row = scene.cluster.wait("p", "running", "checkpointed")
    assert set(instances(scene.cluster, "p")) == ({row.number} - {0})
    wait_until(lambda: not any(scene.images.glob("in-*/criu")), "no second name of an image")
    held = [one for one in scene.images.glob("kept-*") if one.is_dir()]
    assert len(held) == (row.state == "checkpointed")
    scene.cluster.wait_for_hosts()
    scene.be("running")
    scene.check_counts()
