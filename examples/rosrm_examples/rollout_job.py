"""Plan of the rollout demo: three versions of an application, and the drive that it maps.

The second version is good. In the third one the viewer ends soon after its start, so the master
returns to the second one, also with the SLAM, which it had replaced already.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

from rosrm import (
    Client,
    Listing,
    MigrationPolicy,
    ProcessSpec,
    RestartPolicy,
    RolloutPolicy,
    Target,
)
from rosrm.config.settings import ClusterConfig, HostConfig, MigrationSettings
from rosrm_examples.demo_job import NODE_STOP
from rosrm_examples.demo_progress import Progress
from rosrm_examples.demo_record import ENDED
from rosrm_examples.observer import Observer
from rosrm_examples.played_drive import PLAYER, PlayedDrive

HOST: Final = "robot"
APPLICATION: Final = "mapping"
SLAM, VIEWER, RECORDER = "slam", "viewer", "recorder"
#: Bytes of memory in the budget of the host, which must be free on this machine.
BUDGET: Final = 768 * 2**20
#: Seconds for which a new instance must run.
HEALTHY_FOR: Final = 2.0
#: Instances of the SLAM that take over from another one: the second version, the third one, and
#: the second one again.
HANDOFFS: Final = 3

#: Seconds after which the viewer of the third version ends.
_VIEWER_ENDS_S: Final = 1.2
#: MB that the viewer and the recorder of each version hold.
_VIEWER_MB: Final = {1: 20, 2: 30, 3: 30}
_RECORDER_MB: Final = {1: 10, 2: 15, 3: 15}
#: Keyframes after which the SLAM of each version publishes its map.
_MAP_EVERY: Final = {1: 10, 2: 5, 3: 4}
#: Scans that are mapped before the next version is applied.
_SCANS_BETWEEN: Final = 20


def cluster_config() -> ClusterConfig:
    """Return the master's settings: no migration but those of the rollout."""
    return ClusterConfig(
        name="rollout-demo",
        migration=MigrationSettings(
            strategies={"handoff": {}, "relaunch": {}}, automatic=False, max_in_flight=1
        ),
    )


def host_config(cores: int) -> HostConfig:
    """Return the only host."""
    return HostConfig(
        host=HOST, scope="slice", budget={"memory": BUDGET, "cpu": 2 * cores, "disk": 2**30}
    )


def target(live: PlayedDrive, version: int) -> Target:
    """Return a version of the application, from 1 to 3."""
    specs = (_slam(live, version), _viewer(version), _recorder(version))
    return Target(APPLICATION, specs, rollout=RolloutPolicy(healthy_for=HEALTHY_FOR))


def _slam(live: PlayedDrive, version: int) -> ProcessSpec:
    """Return the process that hands over its state."""
    return ProcessSpec(
        name=SLAM,
        module="rosrm_examples.slam_node",
        parameters={"out": str(live.out), "map_every": _MAP_EVERY[version]},
        environment={"OMP_NUM_THREADS": "1"},
        ros=True,
        migration=MigrationPolicy("handoff"),
        stop=NODE_STOP,
        application=APPLICATION,
    )


def _viewer(version: int) -> ProcessSpec:
    """Return a process without a state: the new one starts, then the old one stops."""
    viewer = ProcessSpec(
        name=VIEWER,
        module="rosrm_examples.holder",
        arguments=("--mb", str(_VIEWER_MB[version])),
        migration=MigrationPolicy("relaunch"),
        restart=RestartPolicy("on-failure"),
        application=APPLICATION,
    )
    faulty = ("sh", "-c", f"sleep {_VIEWER_ENDS_S}; exit 3")
    return replace(viewer, module="", arguments=(), command=faulty) if version == 3 else viewer


def _recorder(version: int) -> ProcessSpec:
    """Return a process that may run once only: the old one stops, then the new one starts."""
    return ProcessSpec(
        name=RECORDER,
        module="rosrm_examples.holder",
        arguments=("--mb", str(_RECORDER_MB[version])),
        application=APPLICATION,
    )


class RolloutScript:
    """A script that applies version after version, and ends when all scans are mapped."""

    def __init__(self, live: PlayedDrive, observer: Observer) -> None:
        self._live = live
        self._observer = observer
        self._applied = 0  # newest version that was requested
        self._reached: list[int] = []  # versions that the application was at, in order
        self._mapped_before = 0
        self._played = False
        self._progress = Progress(observer)

    def act(self, client: Client, elapsed: float) -> None:
        """Request what is due."""
        self._progress.look(elapsed)
        if self._is_due():
            self._applied += 1
            self._progress.note_action()
            client.apply_targets([target(self._live, self._applied)])
        elif self._reached and not self._played and self._observer.publishers():
            self._played = True
            self._progress.note_action()
            client.submit(self._live.player())

    def _is_due(self) -> bool:
        """Return True if the next version is to be applied."""
        if self._applied == 0:
            return True
        done = self._applied == 3 or self._reached[-1:] != [self._applied]
        return not done and self._progress.mapped >= self._mapped_before + _SCANS_BETWEEN

    def is_over(self, view: Listing) -> bool:
        """Return True if the last version was given up and every scan is mapped, or none comes."""
        for event in view.events:
            if event.kind == "application_applied":
                self._reached.append(int(event.facts["version"]))
                self._mapped_before = self._progress.mapped
        rows = {row.name: row for row in view.processes}
        player = rows.get(PLAYER)
        if player is None or player.state not in ENDED:
            return False
        is_settled = self._applied == 3 and len(self._reached) == 3
        ended = self._progress.has_ended(len(self._live.drive))
        return ended if is_settled else self._progress.is_quiet()

    def progress(self, view: Listing) -> str:
        """Return the progress of the drive, and the version that is requested."""
        states = {row.name: row.state for row in view.processes}
        moving = ", ".join(name for name, state in states.items() if state == "migrating")
        what = f", {moving} is replaced" if moving else ""
        return (
            f"{self._progress.mapped:4} of {len(self._live.drive)} scans mapped, "
            f"version {self._applied}{what}"
        )
