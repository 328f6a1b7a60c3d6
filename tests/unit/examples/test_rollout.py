"""The rollout demo: its versions, the spans of instances in its record, and its picture."""

from __future__ import annotations

import json
from math import inf
from pathlib import Path
from types import SimpleNamespace

import pytest

from rosrm.model.rows import EventRow, Listing, ProcessRow
from rosrm_examples import rollout_plot
from rosrm_examples.demo_record import Record, Sample
from rosrm_examples.drives import load_drive
from rosrm_examples.played_drive import PlayedDrive
from rosrm_examples.rollout_job import RolloutScript, target
from rosrm_examples.rollout_record import Request, rollout_of

EVENTS = (
    (1.0, "application_requested", "", {"version": 1}),
    (1.1, "assigned", "slam", {"number": 1}),
    (1.1, "assigned", "viewer", {"number": 2}),
    (1.1, "assigned", "recorder", {"number": 3}),
    (1.5, "ready", "slam", {"number": 1}),
    (2.0, "application_applied", "", {"version": 1}),
    (3.0, "application_requested", "", {"version": 2}),
    (3.1, "migration_begun", "slam", {"source": 1, "destination": 4}),
    (3.4, "migration_step", "slam", {"step": "starting slam#4 on robot"}),
    (4.0, "migration_step", "slam", {"step": "the commit"}),
    (4.2, "instance_ended", "slam", {}),
    (4.3, "migrated", "slam", {}),
    (6.3, "replaced", "recorder", {}),
    (6.4, "queued", "recorder", {}),
    (6.5, "assigned", "recorder", {"number": 5}),
    (6.6, "ready", "recorder", {"number": 5}),
    (9.0, "application_applied", "", {"version": 2}),
    (10.0, "application_requested", "", {"version": 3}),
    (10.1, "migration_begun", "viewer", {"source": 2, "destination": 6}),
    (10.2, "migration_step", "viewer", {"step": "the commit"}),
    (10.3, "instance_ended", "viewer", {}),
    (10.4, "migrated", "viewer", {}),
    (11.0, "backoff", "viewer", {}),
    (11.1, "application_returns", "", {"version": 3}),
    (11.1, "replaced", "viewer", {}),
    (11.2, "queued", "viewer", {}),
    (11.2, "assigned", "viewer", {"number": 7}),
    (15.0, "application_applied", "", {"version": 2}),
)


@pytest.fixture
def record() -> Record:
    """Return a record with a good version and a faulty one."""
    rows = [
        EventRow(number, 1e9 + at, at, kind, process, "robot", "", facts)
        for number, (at, kind, process, facts) in enumerate(EVENTS, start=1)
    ]
    samples = [Sample(1.0, {"memory": {"robot": 0.1}}, 3, 0)]
    return Record(("robot",), {"memory": 0.8}, 1000, samples, rows)


@pytest.fixture
def rollout(record):
    return rollout_of(record.events, ["slam", "viewer", "recorder"])


def test_a_version_that_failed_is_followed_by_the_one_before(rollout):
    assert rollout.requests == [
        Request(1.0, 1, returned=False), Request(3.0, 2, returned=False),
        Request(10.0, 3, returned=False), Request(11.1, 2, returned=True),
    ]  # fmt: skip


def test_an_instance_that_is_handed_over_to_runs_beside_the_old_one(rollout):
    old, new = rollout.of("slam")
    assert (old.version, old.begin, old.active, old.successor, old.end) == (1, 1.1, 1.1, 4.0, 4.2)
    assert (new.version, new.begin, new.active, new.successor, new.end) == (2, 3.1, 4.0, inf, inf)
    assert (old.checked, new.checked) == (inf, 4.3)
    assert rollout.healthy_until(new, 2.0) == pytest.approx(6.3)
    assert [rollout.version_at(at) for at in (0.5, 3.5, 4.1)] == [0, 1, 2]


def test_a_process_that_is_stopped_first_has_no_two_instances_at_once(rollout):
    old, new = rollout.of("recorder")
    assert (old.end, new.begin, new.version) == (6.4, 6.5, 2)


def test_an_instance_that_fails_ends_the_check_of_its_health(rollout):
    old, faulty, again = rollout.of("viewer")
    assert (faulty.version, faulty.failed, faulty.end) == (3, True, 11.0)
    assert rollout.healthy_until(faulty, 2.0) == 11.0
    assert (again.version, again.failed, old.failed) == (2, False, False)


def test_the_picture_is_drawn_again_from_the_files(record, tmp_path, capsys):
    record.write(tmp_path)
    (tmp_path / "poses.json").write_text(json.dumps([1e9 + 2.0, 1e9 + 2.1, 1e9 + 5.0]))
    assert rollout_plot.main([str(tmp_path)]) == 0
    assert (tmp_path / "rollout.png").read_bytes().startswith(b"\x89PNG")
    assert rollout_plot.main([str(tmp_path / "nowhere")]) == 2
    assert "holds no record of a rollout" in capsys.readouterr().err


# --- the script -------------------------------------------------------------------------------


class FakeClient:
    """A client that notes what is requested."""

    def __init__(self) -> None:
        self.requested: list[str] = []

    def apply_targets(self, targets) -> None:
        [one] = targets
        slam = next(spec for spec in one.specs if spec.name == "slam")
        self.requested.append(f"map_every {slam.parameters['map_every']}")

    def submit(self, spec) -> None:
        self.requested.append(spec.name)


def view(*applied: int, player: str = "running") -> Listing:
    row = ProcessRow(
        name="player", kind="job", state=player, host="robot", number=1, pid=1, restarts=0,
        migrations=0, exit_code=0, priority=0, queue_position=0, since=1.0, cpu=0.0, memory=0,
        reason="",
    )  # fmt: skip
    events = [
        EventRow(1, 1e9, 1.0, "application_applied", "", "", "", {"version": version})
        for version in applied
    ]
    return Listing("demo", 1.0, 1, processes=[row], events=events)


def test_each_version_is_applied_once_the_one_before_runs_and_scans_are_mapped():
    drive = load_drive("street:60")
    live = PlayedDrive(drive, 1.0, Path("/out"), Path("/report"), Path("/"))
    observer = SimpleNamespace(received=[], publishers=lambda: 1)
    client, script = FakeClient(), RolloutScript(live, observer)

    def step(mapped: int, *applied: int, player: str = "running") -> bool:
        observer.received[:] = range(mapped)
        is_over = script.is_over(view(*applied, player=player))
        script.act(client, 1.0)
        return is_over

    script.act(client, 0.0)
    assert client.requested == ["map_every 10"]
    step(0)
    assert client.requested == ["map_every 10"]
    step(0, 1)
    assert client.requested[1:] == ["player"]
    step(10)
    step(20)
    assert client.requested[2:] == ["map_every 5"]
    step(30)
    step(40, 2)
    assert len(client.requested) == 3
    step(50)
    assert client.requested[3:] == ["map_every 4"]
    assert not step(60, player="finished")
    assert step(60, 2, player="finished")
    assert len(client.requested) == 4


def test_all_processes_of_a_version_belong_to_the_application():
    live = PlayedDrive(load_drive("street:60"), 1.0, Path("/out"), Path("/report"), Path("/"))
    for version in (1, 2, 3):
        specs = target(live, version).specs
        assert {spec.application for spec in specs} == {"mapping"}
