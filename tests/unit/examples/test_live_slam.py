"""State of the live SLAM in messages, and the part that each instance maps."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy")

from rclpy.serialization import deserialize_message, serialize_message

from rosrm_examples.drives import Drive
from rosrm_examples.errors import PieceError
from rosrm_examples.live_slam import LiveSlam
from rosrm_examples.map_part import load_parts, save_part
from rosrm_examples.migration_results import unmigrated_poses
from rosrm_examples.slam_state import STATES
from rosrm_examples.stamps import seconds_of, stamp_of

SCANS = 24


@pytest.fixture(scope="module")
def drive(street) -> Drive:
    return street(SCANS)


@pytest.fixture(scope="module")
def unmigrated(drive) -> np.ndarray:
    return unmigrated_poses(drive)


class Instance:
    """One instance, with its state as it would be published."""

    def __init__(self, state: str) -> None:
        self.live = LiveSlam()
        self.topics = STATES[state](self.live)
        self.published: dict[str, bytes] = {}

    def go_on(self, drive: Drive, first: int, end: int) -> None:
        for index in range(first, end):
            t = seconds_of(stamp_of(float(drive.times[index])))
            self.live.add_scan(drive.read(index), t)
            self.publish()

    def publish(self) -> None:
        for topic in self.topics:
            message = topic.save()
            if message is not None:
                assert isinstance(message, topic.type)
                self.published[topic.name] = serialize_message(message)

    def follow(self, source: Instance, reverse: bool = False) -> None:
        for topic in reversed(self.topics) if reverse else self.topics:
            topic.restore(deserialize_message(source.published[topic.name], topic.type))


@pytest.mark.parametrize("reverse", [False, True], ids=["in order", "in reverse"])
def test_with_the_full_state_it_goes_on_exactly(drive, unmigrated, reverse) -> None:
    """An earlier state is overwritten, in any order of the parts."""
    source, destination = Instance("full"), Instance("full")
    for at in range(12):
        source.go_on(drive, at, at + 1)
        destination.follow(source, reverse)
    destination.go_on(drive, 12, SCANS)
    poses = np.concatenate([one.live.part("").poses for one in (source, destination)])
    assert np.array_equal(poses, unmigrated)


@pytest.mark.parametrize(
    ("scans_of", "step"), [("drive", 1), ("kitti0001", 4)], ids=["street", "kitti0001"]
)
def test_with_the_full_state_it_goes_on_exactly_from_any_scan(request, scans_of, step) -> None:
    """After one more scan its knowledge is the original's, and so after all the others.

    This is tried after each scan of the street, and after every fourth of 60 of a real drive.
    """
    drive = request.getfixturevalue(scans_of).part(0, 60)
    source = Instance("full")
    source.go_on(drive, 0, 1)
    for at in range(1, len(drive)):
        if (at - 1) % step:
            source.go_on(drive, at, at + 1)
            continue
        destination = Instance("full")
        destination.follow(source)
        for one in (destination, source):
            one.go_on(drive, at, at + 1)
        for mine, theirs in zip(knowledge(destination), knowledge(source), strict=True):
            assert mine.keys() == theirs.keys()
            assert all(np.array_equal(mine[key], theirs[key]) for key in mine), at


def knowledge(one: Instance):
    """Return everything that the next pose depends on."""
    return one.live.slam.motion_state(newest=1), one.live.slam.map_state()


def test_with_the_pose_alone_it_goes_on_within_a_tenth_of_a_metre(drive, unmigrated) -> None:
    """The new map begins with the last scan."""
    source, destination = Instance("pose"), Instance("pose")
    for at in range(12):
        source.go_on(drive, at, at + 1)
        destination.follow(source)
    destination.go_on(drive, 12, SCANS)
    poses = np.concatenate([one.live.part("").poses for one in (source, destination)])
    apart = np.linalg.norm(poses[:, :3, 3] - unmigrated[:, :3, 3], axis=1)
    assert apart[:12].max() == 0.0
    assert 0.0 < apart.max() < 0.1


@pytest.mark.parametrize("state", STATES)
def test_a_successor_takes_over_before_the_first_scan(drive, unmigrated, state) -> None:
    """The empty state replaces an earlier one, though nothing is known yet."""
    source, destination, other = Instance(state), Instance(state), Instance(state)
    other.go_on(drive, 0, 5)
    destination.follow(other)
    source.publish()
    destination.follow(source)
    destination.go_on(drive, 0, SCANS)
    assert np.array_equal(destination.live.part("").poses, unmigrated)


@pytest.mark.parametrize("state", STATES)
def test_from_hand_to_hand(drive, unmigrated, state) -> None:
    """Each of five instances is the destination and then the source of a move."""
    instances = [Instance(state) for _ in range(5)]
    ends = [0, 3, 4, 11, 17, SCANS]
    for number, instance in enumerate(instances):
        if number:
            instance.follow(instances[number - 1])
        instance.go_on(drive, ends[number], ends[number + 1])
    parts = [instance.live.part("") for instance in instances]
    assert [len(part.times) for part in parts] == [3, 1, 7, 6, 7]
    poses = np.concatenate([part.poses for part in parts])
    apart = np.abs(poses[:, :3, 3] - unmigrated[:, :3, 3]).max()
    assert apart == 0.0 if state == "full" else apart < 0.2  # four new maps


def test_the_map_travels_only_when_it_has_changed(drive) -> None:
    """An instance publishes a map that it has taken over, because it has not done so before."""
    source, destination = Instance("full"), Instance("full")
    source.go_on(drive, 0, 3)
    saves = {topic.name: topic.save for topic in source.topics}
    assert saves["~/state/map"]() is None
    assert saves["~/state"]() is not None
    destination.follow(source)
    assert {topic.name for topic in destination.topics if topic.save()} == set(saves)


def test_the_trajectory_does_not_make_the_state_grow(drive) -> None:
    """The part that changes with every scan keeps its small size."""
    source = Instance("full")
    source.go_on(drive, 0, 2)
    before = len(source.published["~/state"])
    source.go_on(drive, 2, SCANS)
    assert len(source.published["~/state"]) == before < 2000


def test_a_part_has_what_its_instance_mapped_and_no_more(drive) -> None:
    """All parts together have as many points, at their places, as the map of one instance."""
    source, destination, one = Instance("full"), Instance("full"), Instance("full")
    one.go_on(drive, 0, SCANS)
    source.go_on(drive, 0, 12)
    destination.follow(source)
    assert len(destination.live.part("").points) == 0
    destination.go_on(drive, 12, SCANS)
    before, after = source.live.part("a"), destination.live.part("b")
    assert np.array_equal(before.points, source.live.slam.map_points())
    assert destination.live.slam.map_points() == pytest.approx(one.live.slam.map_points())
    new = len(after.points)
    assert len(one.live.slam.map_points()) - len(before.points) < new  # some voxels have both
    assert after.points[:, 0].max() > before.points[:, 0].max()


def test_a_scan_that_comes_twice_is_refused_and_counted(drive) -> None:
    """The repeated scan changes nothing."""
    instance = Instance("full")
    instance.go_on(drive, 0, 3)
    with pytest.raises(ValueError, match="must be later"):
        instance.go_on(drive, 2, 3)
    part = instance.live.part("")
    assert (len(part.times), part.refused) == (3, 1)


def test_parts_are_read_in_the_order_of_the_drive(drive, tmp_path: Path) -> None:
    """Their names make no difference."""
    source, destination = Instance("full"), Instance("full")
    source.go_on(drive, 0, 4)
    destination.follow(source)
    destination.go_on(drive, 4, 6)
    save_part(tmp_path / "parts" / "z.npz", source.live.part("left"))
    save_part(tmp_path / "parts" / "a.npz", destination.live.part("right"))
    parts = load_parts(tmp_path / "parts")
    assert [part.host for part in parts] == ["left", "right"]
    assert np.array_equal(parts[1].poses, destination.live.part("").poses)
    with pytest.raises(PieceError, match="no part of a map"):
        load_parts(tmp_path)
