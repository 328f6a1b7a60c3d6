"""Cost of keys: goals of the figures, and what simulated slaves share."""

from __future__ import annotations

import pytest

from benchmarks.sealed import judged
from benchmarks.shared_participant import AskingClient, SharedClient


@pytest.mark.parametrize(
    ("name", "keys", "most", "reached"),
    [
        ("latency_p50_ms", 11.0, 11.0, True),
        ("latency_p99_ms", 11.1, 11.0, False),
        ("us_per_slave_cycle", 14.0, 14.0, True),
        ("handoff_gap_p50_ms", 11.1, 11.0, False),
        ("slave_cpu_s_per_minute", 11.4, 11.5, True),
    ],
)
def test_a_figure_stands_beside_its_goal(name, keys, most, reached) -> None:
    """Some goals are a factor, others a difference."""
    found = judged(name, {"none": 10.0, "keys": keys})
    assert found.pop("ratio") == pytest.approx(keys / 10.0)
    assert found == {"none": 10.0, "keys": keys, "at_most": most, "reached": reached}


def test_a_figure_of_nothing_has_no_ratio() -> None:
    """A gap may be below one period, and thus negative."""
    assert judged("handoff_gap_p50_ms", {"none": -0.3, "keys": 0.1})["ratio"] is None


class Future:
    """Future of a request, which the executor completes."""


class Client:
    """rclpy's client, with numbered requests."""

    def __init__(self) -> None:
        self.futures: dict[int, Future] = {}

    def call_async(self, _request) -> Future:
        return self.futures.setdefault(len(self.futures), Future())

    def get_pending_request(self, sequence: int) -> Future:
        return self.futures[sequence]

    def remove_pending_request(self, _future) -> None:
        raise AssertionError("not used here")

    service_is_ready = remove_pending_request


def test_an_answer_goes_to_the_slave_that_asked() -> None:
    """Each slave opens its answers with its own key, so that no other may take them."""
    client = Client()
    shared = SharedClient(client)
    ada, bob = AskingClient(shared), AskingClient(shared)
    for name, asking in (("ada", ada), ("bob", bob)):
        asking.get_pending_request = lambda sequence, name=name: (name, sequence)
    kept = [ada.call_async("first"), bob.call_async("second"), ada.call_async("third")]
    answered = [client.get_pending_request(number) for number in range(len(kept))]
    assert answered == [("ada", 0), ("bob", 1), ("ada", 2)]


def test_a_request_is_pending_under_its_number() -> None:
    client = Client()
    asking = AskingClient(SharedClient(client))
    future = asking.call_async("request")
    assert client.get_pending_request(0) is future
