"""Plan of the migration demo: a player, the live SLAM, a recorder that grows, and their times.

The player stays on the robot, with its scanner. The SLAM begins on the host with the fast disk, and
has to leave it when the recorder, which needs that disk, takes the memory.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from rosrm import Client, Listing, MigrationPolicy, ProcessRow, ProcessSpec
from rosrm.config.settings import ClusterConfig, HostConfig, MigrationSettings, ScoringChoice
from rosrm_examples.demo_job import MEMORY_LIMIT, NODE_STOP
from rosrm_examples.demo_progress import Progress
from rosrm_examples.demo_record import ENDED
from rosrm_examples.drives import Drive
from rosrm_examples.observer import Observer
from rosrm_examples.played_drive import PLAYER, PlayedDrive

#: The SLAM begins on the first; the player stays on the last.
HOSTS: Final = ("host1", "host2", "robot")
SLAM, RECORDER = "slam", "recorder"
#: Bytes of memory in the budgets of host1 and host2, and of the robot.
BUDGET: Final = 448 * 2**20
_ROBOT_BUDGET: Final = 160 * 2**20
#: Bytes that must be free on this machine: for the processes on the hosts, and rosrm.
LEAST_FREE: Final = 2 * BUDGET

#: MB, declared.
_SLAM_MB, _PLAYER_MB, _RECORDER_MB = 130, 90, 33
#: MB that the recorder takes in the end, and in each second until then; not declared.
_RECORDER_MOST_MB, _RECORDER_GROWTH_MB = 350, 200

_FAST_DISK: Final = {"disk": "fast"}
_SCANNER: Final = {"scanner": "yes"}

#: Seconds; a shorter drive is played slower, because processes need time to start.
_SHORTEST_S: Final = 20.0
#: Part of the drive after which the recorder is submitted; the SLAM migrates soon after.
_RECORDER_AT: Final = 0.15


@dataclass(frozen=True)
class LiveDrive(PlayedDrive):
    """A drive with the settings for playing and mapping it.

    Attributes:
        state: of the SLAM that migrates: "full" or "pose".
    """

    state: str


def usual_rate(drive: Drive) -> float:
    """Return the rate of playing: 1, or less where the drive is too short for a migration."""
    return min(1.0, float(drive.times[-1] - drive.times[0]) / _SHORTEST_S)


def cluster_config() -> ClusterConfig:
    """Return the master's settings: stateful processes migrate by handoff."""
    return ClusterConfig(
        name="migration-demo",
        scoring=(ScoringChoice(options={"weights": {"memory": 1.0}}),),
        migration=MigrationSettings(
            strategies={"handoff": {}}, hysteresis=0.5, cooldown=120.0, headroom=0.02,
            max_in_flight=1,
        ),
    )  # fmt: skip


def host_configs(cores: int) -> list[HostConfig]:
    """Return three hosts on one machine: each measures its own processes against a budget."""
    labels = dict(zip(HOSTS, (_FAST_DISK, {}, _SCANNER), strict=True))
    return [
        HostConfig(
            host=name,
            labels=labels[name],
            scope="slice",
            budget={
                "memory": _ROBOT_BUDGET if labels[name] == _SCANNER else BUDGET,
                "cpu": 2 * cores,  # enough for a SLAM on all cores; memory is the scarce resource
                "disk": 2**30,
            },
            limits={"memory": MEMORY_LIMIT, "cpu": 1.0},
        )
        for name in HOSTS
    ]


def slam_spec(live: LiveDrive) -> ProcessSpec:
    """Return the process that migrates."""
    return ProcessSpec(
        name=SLAM,
        module="rosrm_examples.slam_node",
        parameters={"state": live.state, "out": str(live.out)},
        environment={"OMP_NUM_THREADS": "1"},
        ros=True,
        needs={"memory": _SLAM_MB * 1e6},
        preferred_labels=_FAST_DISK,
        migration=MigrationPolicy(strategy="handoff"),
        stop=NODE_STOP,
    )


def player_spec(live: LiveDrive) -> ProcessSpec:
    """Return the player, which starts when the SLAM has subscribed."""
    return live.player(needs={"memory": _PLAYER_MB * 1e6}, required_labels=_SCANNER)


def recorder_spec() -> ProcessSpec:
    """Return the recorder: it takes more memory than declared, on the host with the fast disk."""
    return ProcessSpec(
        name=RECORDER,
        module="rosrm_examples.holder",
        arguments=(
            "--mb", "20", "--grow", str(_RECORDER_GROWTH_MB), "--most", str(_RECORDER_MOST_MB),
        ),
        needs={"memory": _RECORDER_MB * 1e6},
        required_labels=_FAST_DISK,
    )  # fmt: skip


class MigrationScript:
    """A script for SLAM, player and recorder that ends when all scans are mapped.

    The cluster's end then ends the SLAM and the recorder.
    """

    def __init__(self, live: LiveDrive, observer: Observer) -> None:
        self._live = live
        self._observer = observer
        self._rows: dict[str, ProcessRow] = {}
        self._submitted: set[str] = set()
        self._progress = Progress(observer)

    def act(self, client: Client, elapsed: float) -> None:
        """Submit the processes that are due."""
        self._progress.look(elapsed)
        for spec in self._due():
            client.submit([spec])
            self._submitted.add(spec.name)
            self._progress.note_action()

    def _due(self) -> Sequence[ProcessSpec]:
        scans = len(self._live.drive)
        if SLAM not in self._submitted:
            return [slam_spec(self._live)]
        if PLAYER not in self._submitted:
            return [player_spec(self._live)] if self._slam_listens() else []
        if RECORDER not in self._submitted and self._progress.mapped >= _RECORDER_AT * scans:
            return [recorder_spec()]
        return []

    def _slam_listens(self) -> bool:
        slam = self._rows.get(SLAM)
        return slam is not None and slam.state == "running" and self._observer.publishers() > 0

    def is_over(self, view: Listing) -> bool:
        """Return True if the player has ended, and all poses were received or no more come."""
        self._rows = {row.name: row for row in view.processes}
        player = self._rows.get(PLAYER)
        if player is None or player.state not in ENDED or self._rows[SLAM].state == "migrating":
            return False
        return self._progress.has_ended(len(self._live.drive))

    def progress(self, view: Listing) -> str:
        """Return the progress of the drive, and the host that maps it."""
        slam = next((row for row in view.processes if row.name == SLAM), None)
        if slam is None:
            return "the SLAM is to start"
        where = f"on {slam.host}" if slam.host else "on no host yet"
        moving = ", it moves" if slam.state == "migrating" else ""
        return f"{self._progress.mapped:4} of {len(self._live.drive)} scans mapped, {where}{moving}"
