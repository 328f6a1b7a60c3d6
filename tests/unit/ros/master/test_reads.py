"""Read-only requests in turns between their senders."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

from rosrm.model.ledger import Store, bound_of
from rosrm.model.requester import Requester
from rosrm.ros.master.reads import FairReads

VIEWER, ALICE = Requester("user:viewer"), Requester("user:alice")
MOST = bound_of(Store.LISTINGS, is_operator=False).number


class Loop:
    """A loop that handles one message after the other."""

    def __init__(self) -> None:
        self.posted: deque[Callable[[], None]] = deque()
        self.done: list[str] = []
        self.reads = FairReads(self.posted.append)

    def listing(self, by: Requester, name: str) -> None:
        self.reads.add(by, lambda: self.done.append(name))

    def run(self) -> list[str]:
        while self.posted:
            self.posted.popleft()()
        return self.done


def test_a_command_waits_for_one_listing_at_most() -> None:
    """The command comes before the other 199 listings of a viewer."""
    loop = Loop()
    for number in range(200):
        loop.listing(VIEWER, f"listing {number}")
    loop.posted.append(lambda: loop.done.append("command"))
    assert loop.run()[:2] == ["listing 0", "command"]


def test_senders_take_turns() -> None:
    """The listing of another user does not wait for all of the first one."""
    loop = Loop()
    for number in range(200):
        loop.listing(VIEWER, f"viewer {number}")
    loop.listing(ALICE, "alice")
    assert loop.run()[:3] == ["viewer 0", "alice", "viewer 1"]


def test_listings_in_flight_are_bounded_by_sender() -> None:
    """Those beyond the bound are dropped, and later ones are answered again."""
    loop = Loop()
    for number in range(200):
        loop.listing(VIEWER, f"viewer {number}")
    assert len(loop.run()) == MOST
    loop.listing(VIEWER, "later")
    assert loop.run()[-1] == "later"
