"""Master endpoint: messages become events, commands become messages.

Its parts are in files of their own:

- `subscriptions.py`: messages published by slaves;
- `services.py`: requests of slaves and clients;
- `slave_links.py`: orders to slaves;
- `handoff.py`: reports and signals of handoffs;
- `rivals.py`: another master.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Final

from rosrm import clocks
from rosrm.config.settings import ControlSettings
from rosrm.core.master import events as happened
from rosrm.keys.security import Authority
from rosrm.ros import names, qos
from rosrm.ros.introductions import ticket_version
from rosrm.ros.master.handoff import HandoffEndpoint
from rosrm.ros.master.load import MasterLoad
from rosrm.ros.master.refusals import Refusals
from rosrm.ros.master.rivals import RivalWatch
from rosrm.ros.master.services import MasterIdentity, MasterServices, Queries
from rosrm.ros.master.slave_links import HostLinks
from rosrm.ros.master.strangers import Strangers
from rosrm.ros.master.subscriptions import SlaveSubscriptions
from rosrm.ros.sealed import SealedEndpoints
from rosrm.version import PROTOCOL_VERSION
from rosrm_msgs import msg

#: Seconds between two load messages of the master.
_LOAD_EVERY: Final = 1.0


class MasterEndpoint:
    """The parts that exchange the master's messages; its beats and readings.

    Attributes:
        events: received since the runtime took them last.
        links: sends orders and assignments to slaves.
        services: answers requests of slaves and clients.
        handoffs: exchanges messages with nodes of handoffs.
        rivals: finds another master.
        load: takes the durations of the runtime's work.
        incarnation: random number of this run of the master.
    """

    def __init__(
        self, endpoints: SealedEndpoints[Authority], identity: MasterIdentity, queries: Queries,
        control: ControlSettings,
    ) -> None:  # fmt: skip
        participant, security = endpoints.participant, endpoints.security
        self._identity = identity
        self._guard = participant.guard
        self.events: list[happened.Event] = []
        self.incarnation = identity.incarnation
        refuse = Refusals(self.events.append)
        self._strangers = strangers = Strangers(refuse)
        endpoints.refused = strangers.note
        self._security = security
        self.links = HostLinks(
            endpoints, f"master {identity.name}", identity.epoch, control.order_retry,
            self.events.append,
        )  # fmt: skip
        self.handoffs = HandoffEndpoint(
            participant, identity.name, identity.epoch, self.events.append, refuse,
            keys=security.handoff_keys(queries.host_of),
        )  # fmt: skip
        self._subscriptions = SlaveSubscriptions(
            endpoints, self.links, self.events.append, refuse, strangers
        )
        self.rivals = RivalWatch(
            endpoints, identity,
            lambda who, reason: refuse("master_beat", who, reason),
        )  # fmt: skip
        self._open_topics(endpoints)
        self.services = MasterServices(
            endpoints, self.links, identity, queries,
            control=control, handle=self.events.append,
            refuse=refuse, strangers=strangers.sentence,
        )  # fmt: skip

    def _open_topics(self, endpoints: SealedEndpoints[Authority]) -> None:
        path = names.Names(endpoints.participant.settings.namespace)
        topic = path(names.MASTER_BEAT)
        endpoints.follow(msg.MasterBeat, topic, qos.BEAT, self.rivals.take_beat)
        self._beats = endpoints.announcer(msg.MasterBeat, topic, qos.BEAT)
        self._loads = endpoints.announcer(msg.Event, path(names.MASTER_LOAD), qos.LOAD)
        self._load_at = 0.0
        self._oldest: list[float] = []
        self.load = MasterLoad()

    def shut_revoked(self) -> None:
        """End the conversations with slaves whose key is no longer valid."""
        self.links.shut_revoked(self._security.has_access)

    def poll_readings(self) -> None:
        """Take new readings, even when no other event occurs; called in every tick."""
        self._guard.call(self._take_readings)
        self._oldest.append(self.links.reading_stats.ages(clocks.boot_time())[1])

    def poll_first_readings(self) -> None:
        """Take new readings if requests of slaves wait for them; called once before `take_events`.

        A slave sends its first reading before its first request for work.
        """
        if self.links.awaits_first_readings:
            self._guard.call(self._take_readings)

    def _take_readings(self) -> None:
        readings = self._subscriptions.poll_readings()
        if readings is not None:
            # Placed first, because a usage must not be judged by readings older than it.
            self.events.insert(0, readings)

    def take_events(self, *, queued: bool = True) -> list[happened.Event]:
        """Return the events since the last call, in order, preceded by the newest readings.

        Args:
            queued: False if no process is queued. Then requests for work and measurements of links
                decide nothing, and the readings can wait for the next tick.
        """
        if not self._begin_with_readings() and (queued or not all(map(_is_routine, self.events))):
            self._guard.call(self._take_readings)
        events = list(self.events)
        self.events.clear()
        return events

    def _begin_with_readings(self) -> bool:
        return not self.events or isinstance(self.events[0], happened.ReadingsReceived)

    def beat(self, uptime: float, silent_hosts: Sequence[int], journal: int) -> None:
        """Publish the master's beat, and its load at most once a second.

        Args:
            silent_hosts: numbers of the hosts whose messages the master does not receive.
            journal: sequence of the newest written record.
        """
        self.links.note_silent(silent_hosts)
        identity = self._identity
        self._beats.publish(
            msg.MasterBeat(
                protocol_version=PROTOCOL_VERSION, name=identity.name, hostname=identity.hostname,
                pid=identity.pid, epoch=identity.epoch, incarnation=identity.incarnation,
                beat=clocks.boot_time_ns(), uptime=uptime, journal=journal,
                tickets_from=ticket_version(identity.epoch, self._security),
                silent_hosts=list(silent_hosts),
            )
        )  # fmt: skip
        if uptime - self._load_at >= _LOAD_EVERY:
            self._load_at = uptime
            self._publish_load(uptime)

    def _publish_load(self, uptime: float) -> None:
        """Publish statistics that show if the master keeps up with its slaves' messages."""
        stats = self.links.reading_stats
        hosts, _ = stats.ages(clocks.boot_time())
        oldest, self._oldest = self._oldest, []
        facts = {
            "hosts": hosts, "cycles": stats.cycles, "missed": stats.missed,
            "oldest_reading_s": [round(age, 4) for age in oldest],
            "dropped": self._guard.dropped, "strangers": self._strangers.total, **self.load.take(),
        }  # fmt: skip
        self._loads.publish(
            msg.Event(
                wall_time=clocks.wall_time(), elapsed=uptime, kind="load", data=json.dumps(facts),
                message=f"{hosts} hosts report, {stats.missed} of "
                f"{stats.cycles + stats.missed} cycles were missed, the oldest reading is "
                f"{max(oldest, default=0.0):.2f} s old",
            )
        )  # fmt: skip


def _is_routine(event: happened.Event) -> bool:
    """Return True if an event causes no decision while no process is queued."""
    if isinstance(event, happened.OrderAnswered):
        return event.is_measurement
    return isinstance(event, happened.ProcessRequested)
