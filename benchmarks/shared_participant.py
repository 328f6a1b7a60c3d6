"""DDS participant that many simulated slaves share, and the place of each in it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from rosrm.model.ros_settings import RosSettings
from rosrm.ros.participant import OpenRequest, Participant
from rosrm_msgs import msg, srv


class Berth:
    """One slave's place in the participant that it shares with others.

    It replaces a `Participant` and its node for one `SlaveEndpoint`.
    """

    def __init__(self, shared: SharedParticipant) -> None:
        self._shared = shared
        self.node = self
        self.settings = shared.participant.settings
        self.guard = shared.participant.guard

    def create_client(self, kind: Any, name: str, *, qos_profile: Any) -> Any:
        """Return a client; an own one only where answers reach many."""
        return self._shared.client(kind, name, qos_profile)

    def create_publisher(self, kind: Any, name: str, qos: Any) -> Any:
        """Return a publisher; an own one for the readings."""
        return self._shared.publisher(kind, name, qos)

    def create_subscription(
        self, kind: Any, name: str, take: Callable[[Any], None], qos: Any
    ) -> None:
        """Add a callback to those of a topic."""
        self._shared.hear(kind, name, take, qos)

    def counted(self, callback: Callable[..., None]) -> Callable[..., None]:
        """Wrap a callback as the participant does."""
        return self._shared.participant.counted(callback)

    def serve(self, kind: Any, name: str, handle: Callable[[Any, OpenRequest], None]) -> None:
        """Offer an own service; none for `ReadLog`, because there are no logs."""
        if kind is not srv.ReadLog:
            self._shared.participant.serve(kind, name, handle)


@dataclass
class Tally:
    """The counts of all slaves of a process.

    Attributes:
        cycles: of all slaves that are registered.
        late: of those, more than a period after they were due; cycles skipped by them do not count.
        messages: readings that were sent.
        lost: times that a slave lost its master.
        taken: unix times at which assignments came.
    """

    cycles: int = 0
    late: int = 0
    messages: int = 0
    lost: int = 0
    taken: dict[str, float] = field(default_factory=dict)

    def begin(self) -> None:
        """Reset the counts."""
        self.cycles = self.late = self.messages = self.lost = 0


@dataclass
class CountedPublisher:
    """A publisher of readings that counts them in a tally."""

    publisher: Any
    tally: Tally

    def publish(self, message: bytes) -> None:
        """Send a reading."""
        self.tally.messages += 1
        self.publisher.publish(message)


class SharedParticipant:
    """One participant for many slaves."""

    def __init__(self, settings: RosSettings, name: str, tally: Tally) -> None:
        self._tally = tally
        self.participant = Participant(settings, name, pace="steady")
        self._clients: dict[Any, Any] = {}
        self._publishers: dict[Any, Any] = {}
        self._hearers: dict[Any, list[Callable[[Any], None]]] = {}

    def client(self, kind: Any, name: str, qos_profile: Any) -> Any:
        """Return the shared client of a service, or a new one for `request_process`."""
        if kind in self._clients:
            return self._clients[kind]
        made = self.participant.node.create_client(kind, name, qos_profile=qos_profile)
        if kind is not srv.RequestProcess:
            self._clients[kind] = made
        return made

    def publisher(self, kind: Any, name: str, qos: Any) -> Any:
        """Return the shared publisher of a topic, or a new one for `resource_info`."""
        if kind in self._publishers:
            return self._publishers[kind]
        made = self.participant.node.create_publisher(kind, name, qos)
        if kind is msg.ResourceInfo:
            return CountedPublisher(made, self._tally)
        self._publishers[kind] = made
        return made

    def hear(self, kind: Any, name: str, take: Callable[[Any], None], qos: Any) -> None:
        """Pass each message of a topic to `take`, by one subscription for all."""
        if kind in self._hearers:
            self._hearers[kind].append(take)
            return
        hearers = self._hearers[kind] = [take]

        def pass_on(message: Any) -> None:
            for hearer in hearers:
                hearer(message)

        self.participant.node.create_subscription(kind, name, pass_on, qos)
