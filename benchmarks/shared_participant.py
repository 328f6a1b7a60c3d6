"""DDS participant that many simulated slaves share, and the place of each in it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, cast
from weakref import WeakKeyDictionary

from rosrm.keys.security import Member
from rosrm.model.ros_settings import RosSettings
from rosrm.ros import names
from rosrm.ros.participant import OpenRequest, Participant
from rosrm.ros.sealed import SealedEndpoints
from rosrm_msgs import msg


class Berth:
    """One slave's place in the participant that it shares with others.

    It replaces a `Participant` and its node for the endpoints of one slave.
    """

    def __init__(self, shared: SharedParticipant) -> None:
        self._shared = shared
        self.node = self
        self.settings = shared.participant.settings
        self.guard = shared.participant.guard
        self.counted = shared.participant.counted

    def create_client(self, kind: Any, name: str, *, qos_profile: Any) -> Any:
        """Return one slave's view of the shared client of a service."""
        return self._shared.client(kind, name, qos_profile)

    def create_publisher(self, kind: Any, name: str, qos: Any) -> Any:
        """Return a publisher; an own one for the readings."""
        return self._shared.publisher(kind, name, qos)

    def serve(self, kind: Any, name: str, handle: Callable[[Any, OpenRequest], None]) -> None:
        """Offer an own service; none for logs, because there are none."""
        if not name.endswith(f"/{names.READ_LOG}"):
            self._shared.participant.serve(kind, name, handle)


class BerthEndpoints(SealedEndpoints[Member]):
    """Sealed entities of one slave, which has a key of its own, in a participant of many."""

    def __init__(self, shared: SharedParticipant, security: Member) -> None:
        super().__init__(cast("Participant", Berth(shared)), security)
        self._shared = shared

    def follow(
        self, message_type: Any, name: str, profile: Any, take: Callable[[Any, bytes], None]
    ) -> None:
        """Add a callback to those of a signed topic.

        One slave checks the signature for all of this process. Real slaves check it on different
        machines. Here hundreds of checks of each beat would occupy the processor of the master,
        whose cost is measured.
        """
        if name not in self._shared.followers:
            self._shared.followers[name] = []
            reader = SealedEndpoints(self._shared.participant, self.security)
            reader.follow(message_type, name, profile, self._shared.passes_on(name))
        self._shared.followers[name].append(take)


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


class SharedClient:
    """A client of a service for many slaves: each answer goes to the slave that asked."""

    def __init__(self, client: Any) -> None:
        self.entity = client
        self.pending_of = client.get_pending_request
        self.askers: WeakKeyDictionary[Any, AskingClient] = WeakKeyDictionary()
        self._is_ready = False
        # The executor calls this method with the number of each answer.
        client.get_pending_request = self._pending_of_asker

    def service_is_ready(self) -> bool:
        """Return True if the service was found; rmw searches the endpoints of all slaves for it."""
        self._is_ready = self._is_ready or self.entity.service_is_ready()
        return self._is_ready

    def _pending_of_asker(self, sequence: int) -> Any:
        return self.askers[self.pending_of(sequence)].get_pending_request(sequence)


class AskingClient:
    """One slave's use of a shared client; its `SealedClient` replaces `get_pending_request`."""

    def __init__(self, shared: SharedClient) -> None:
        self._shared = shared
        self.get_pending_request = shared.pending_of
        self.remove_pending_request = shared.entity.remove_pending_request
        self.service_is_ready = shared.service_is_ready

    def call_async(self, request: Any) -> Any:
        """Send a request; return the future of its answer."""
        future = self._shared.entity.call_async(request)
        self._shared.askers[future] = self
        return future


class SharedParticipant:
    """One participant for many slaves.

    Attributes:
        followers: callbacks for the signed messages of each topic.
    """

    def __init__(self, settings: RosSettings, name: str, tally: Tally) -> None:
        self._tally = tally
        self.participant = Participant(settings, name, pace="steady")
        self.followers: dict[str, list[Callable[[Any, bytes], None]]] = {}
        self._clients: dict[str, SharedClient] = {}
        self._publishers: dict[str, Any] = {}

    def client(self, kind: Any, name: str, qos_profile: Any) -> Any:
        """Return one slave's view of the shared client of a service."""
        if name not in self._clients:
            made = self.participant.node.create_client(kind, name, qos_profile=qos_profile)
            self._clients[name] = SharedClient(made)
        return AskingClient(self._clients[name])

    def publisher(self, kind: Any, name: str, qos: Any) -> Any:
        """Return the shared publisher of a topic, or a new one for `resource_info`."""
        if name in self._publishers:
            return self._publishers[name]
        made = self.participant.node.create_publisher(kind, name, qos)
        if kind is msg.SealedReading:
            return CountedPublisher(made, self._tally)
        self._publishers[name] = made
        return made

    def passes_on(self, name: str) -> Callable[[Any, bytes], None]:
        """Return a callback that calls all followers of a topic."""

        def pass_on(message: Any, run: bytes) -> None:
            for take in self.followers[name]:
                take(message, run)

        return pass_on
