"""Choice of the topics whose rates are sampled."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from rosrm.ros.slave.flows import FlowSampler


@pytest.mark.parametrize(("publishers", "looked_at"), [(0, [0, 10, 20]), (2, [0, 300])])
def test_a_topic_without_a_publisher_is_looked_at_again_soon(publishers, looked_at) -> None:
    """Its publisher may be discovered late; with several publishers nothing changes soon."""
    now, found = [0.0], []

    def publishers_of(_topic: str) -> list[object]:
        found.append(int(now[0]))
        return [object()] * publishers

    node = SimpleNamespace(
        get_subscriber_names_and_types_by_node=lambda *_: [("/image", ["std_msgs/msg/String"])],
        get_publishers_info_by_topic=publishers_of,
    )
    sampler = FlowSampler(lambda: node, clock=lambda: now[0], cpu=lambda: 0.0)
    while len(found) < len(looked_at):
        sampler.look({1: "/viewer"})
        now[0] += 1.0
        assert now[0] < 1000.0, found
    assert sampler.rates() == {}
    assert all(before <= at <= before + 6 for at, before in zip(found, looked_at, strict=True)), (
        found
    )


def test_the_cpu_time_of_making_the_node_delays_no_sample() -> None:
    """The CPU time is spent once, mostly before a topic is discovered."""
    now, cpu, looks = [0.0], [0.0], []

    def topics_of(*_: str) -> list[object]:
        looks.append(now[0])
        return []

    def make_node() -> SimpleNamespace:
        cpu[0] += 1.0
        return SimpleNamespace(get_subscriber_names_and_types_by_node=topics_of)

    sampler = FlowSampler(make_node, clock=lambda: now[0], cpu=lambda: cpu[0])
    while len(looks) < 2:
        sampler.look({1: "/viewer"})
        now[0] += 1.0
        assert now[0] < 1000.0, looks
    assert looks == [0.0, 5.0]
