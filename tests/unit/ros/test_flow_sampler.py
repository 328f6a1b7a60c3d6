"""Choice of the topics whose rates are sampled."""

from __future__ import annotations

import contextlib
from types import SimpleNamespace

import pytest

from rosrm.model.links import LinkReport, report_from_json
from rosrm.ros.slave import flows
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


class Graph:
    """A ROS graph in which one node subscribes to topics, each with a publisher of its name.

    Attributes:
        topics: name of each topic to bytes a second.
    """

    def __init__(self, monkeypatch, topics: dict[str, float]) -> None:
        self.now, self.topics = 0.0, topics
        monkeypatch.setattr(flows, "message_type", lambda kind: kind)
        monkeypatch.setattr(flows, "polled_subscription", lambda *words: words[2])
        monkeypatch.setattr(flows, "waiting", self.messages)
        self.sampler = FlowSampler(lambda: self, clock=lambda: self.now, cpu=lambda: 0.0)

    def get_subscriber_names_and_types_by_node(self, *_: str) -> list[tuple[str, list[str]]]:
        return [(topic, ["std_msgs/msg/String"]) for topic in self.topics]

    def get_publishers_info_by_topic(self, topic: str) -> list[SimpleNamespace]:
        return [SimpleNamespace(node_namespace="/", node_name=topic[1:])]

    def destroy_subscription(self, _: object) -> None:
        pass

    def messages(self, topic: str, _most: int) -> list[tuple[bytes, dict[str, int]]]:
        """Return two messages of 100 bytes at the rate of the topic; [] for none."""
        rate = self.topics.get(topic, 0.0)
        stamps = [0, max(1, round(100 / rate * 1e9))] if rate else []
        return [
            (bytes(100), {"publication_sequence_number": number, "source_timestamp": stamp})
            for number, stamp in enumerate(stamps)
        ]

    def run(self, seconds: float) -> dict[int, dict[str, float]]:
        for _ in range(round(seconds)):
            self.now += 1.0
            self.sampler.look({1: "/viewer"})
        return self.sampler.rates()


def test_a_subscription_that_is_gone_has_no_rate(monkeypatch) -> None:
    """While its instance lives, and other topics keep theirs."""
    graph = Graph(monkeypatch, {"/camera": 500.0, "/lidar": 20.0})
    assert graph.run(20.0) == {1: {"/camera": 500.0, "/lidar": 20.0}}
    del graph.topics["/camera"]
    assert graph.run(10.0) == {1: {"/lidar": 20.0}}


def test_a_topic_without_a_message_has_no_rate_after_its_next_sample(monkeypatch) -> None:
    """Each topic is sampled again after five minutes."""
    graph = Graph(monkeypatch, {"/camera": 500.0})
    assert graph.run(20.0) == {1: {"/camera": 500.0}}
    graph.topics["/camera"] = 0.0
    assert graph.run(320.0) == {}


def test_only_flows_that_the_master_accepts_are_reported(monkeypatch, caplog) -> None:
    """The largest ones; a rate from wrong time stamps is reported as the greatest possible one."""
    caplog.set_level("INFO")
    topics = {f"/t{number}": float(number) for number in range(1, 521)} | {"/odd": 1.0}
    graph = Graph(monkeypatch, topics)
    graph.sampler._rates = {(1, one): (one, rate) for one, rate in topics.items()}
    graph.sampler._rates[2, "/odd"] = ("/odd", 1e22)
    rates = graph.sampler.rates()
    assert sum(map(len, rates.values())) == 512
    assert rates[2] == {"/odd": 1e15}
    assert "/t520" in rates[1]
    assert "/t9" not in rates[1]
    report = LinkReport(flows=rates).to_json()
    assert report_from_json(report) == (LinkReport(flows=rates), [])
    graph.sampler.rates()
    (line,) = caplog.messages
    assert line == (
        "flows: of 522 only the 512 largest are reported, and no rate above 1e+15 B/s; the largest "
        "one is of /odd: 1e+22 B/s"
    )


def test_an_error_of_the_middleware_lets_no_sample_begin_at_once() -> None:
    """Otherwise the slave would use more than its part of a core."""
    now, looks = [0.0], []

    def fails(*_: str) -> list[object]:
        looks.append(now[0])
        raise RuntimeError("out of order")

    topics = [(name, ["std_msgs/msg/String"]) for name in ("/image", "/scan")]
    node = SimpleNamespace(
        get_subscriber_names_and_types_by_node=lambda *_: topics,
        get_publishers_info_by_topic=fails,
    )
    sampler = FlowSampler(lambda: node, clock=lambda: now[0], cpu=lambda: 0.0)
    for _ in range(4):
        with contextlib.suppress(RuntimeError):
            sampler.look({1: "/viewer"})
        now[0] += 1.0
    assert looks == [0.0]
