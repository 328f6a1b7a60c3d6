"""Contract of event sinks with `rosrm alerts`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

from rosrm.extensions.sinks import EventSink, SinkOffer
from rosrm.model.notices import Notice
from rosrm.model.values import EMPTY
from rosrm.testing.calls import call, made

#: Seconds for one call; rosrm itself sets no limit, because each sink has its own thread.
_CALL_LIMIT = 30.0


class EventSinkContract:
    """Contract of an event sink.

    Attributes:
        offer: the tested offer.
    """

    offer: ClassVar[SinkOffer]

    def options(self) -> Mapping[str, Any]:
        """Return the options of a new sink by name, as in alerts.yaml; override this."""
        return EMPTY

    def received(self) -> Sequence[str]:
        """Return the ids of the notices that the receiver got, after `close`; override this."""
        raise NotImplementedError

    def make(self) -> EventSink:
        """Return a new sink."""
        sink: EventSink = made("sink", self.offer, self.options())
        return sink

    def notices(self) -> list[Notice]:
        """Return notices of all forms: with and without a host, a process, an alert and facts."""
        odd = 'a "quoted" <b>name</b>; $(true) {host}\nsecond line \N{SNOWMAN}'
        return [
            Notice("event-1", 1700000000.25, "host_registered", "a host registered", host="h"),
            Notice(
                "event-2", 1700000001.0, "failed", odd, "ERROR", "nav/p", "h", facts={"code": -9}
            ),
            Notice("alert-1", 1700000002.0, "alert_begins", "hot", "WARN", host="h", alert="hot"),
            Notice("alert-2", 1700000003.0, "alert_ends", "", alert="hot"),
        ]  # fmt: skip

    def _send(self, sink: EventSink, notices: Sequence[Notice]) -> None:
        call("send", _CALL_LIMIT, lambda: sink.send(notices), sink)

    def test_delivers_each_notice_in_order(self) -> None:
        """The receiver gets all notices, the oldest first, with their ids."""
        sink, notices = self.make(), self.notices()
        for start in range(0, len(notices), self.offer.batch):
            self._send(sink, notices[start : start + self.offer.batch])
        call("close", _CALL_LIMIT, sink.close, sink)
        assert list(self.received()) == [one.id for one in notices]

    def test_accepts_a_notice_twice(self) -> None:
        """A notice is sent again if rosrm was killed before it noted the delivery."""
        sink, notices = self.make(), self.notices()[:1]
        self._send(sink, notices)
        self._send(sink, notices)
        call("close", _CALL_LIMIT, sink.close, sink)
        assert set(self.received()) == {notices[0].id}

    def test_closes_without_a_notice(self) -> None:
        """The sink can be closed before the first notice."""
        sink = self.make()
        call("close", _CALL_LIMIT, sink.close, sink)

    def test_takes_a_batch_of_at_least_one(self) -> None:
        """The offer says how many notices one call may have."""
        assert self.offer.batch >= 1
