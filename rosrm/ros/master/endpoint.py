"""The master's side of the wire: messages become events, commands become messages.

Put together here; each part stands in a file of its own:

- `subscriptions.py`: what slaves publish;
- `services.py`: requests of slaves and clients;
- `slave_links.py`: orders to slaves;
- `handoff.py`: reports and signals of handoffs.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from typing import Final

from rosrm.config.settings import ControlSettings
from rosrm.core.master import events as happened
from rosrm.core.master.commands import Assign, Order, Redeliver, Reply, Withdraw
from rosrm.ros import names, qos
from rosrm.ros.master.handoff import HandoffEndpoint
from rosrm.ros.master.services import Identity, MasterServices, Queries
from rosrm.ros.master.slave_links import HostLinks
from rosrm.ros.master.subscriptions import Hearing, Refusals
from rosrm.ros.participant import Participant
from rosrm.version import PROTOCOL_VERSION
from rosrm_msgs import msg

__all__ = ["Identity", "MasterEndpoint", "Queries"]

#: Seconds between two words about how the master keeps up.
_LOAD_EVERY: Final = 1.0


class MasterEndpoint:
    """Everything that the master says and hears.

    Attributes:
        events: what happened since the runtime took them last.
        handoffs: what is said and heard of handoffs.
        rival: the newest beat of another master; None: none was heard since it was judged.
        incarnation: random number of this run of the master.
    """

    def __init__(
        self,
        participant: Participant,
        identity: Identity,
        queries: Queries,
        beat: Callable[[], int],
        control: ControlSettings,
    ) -> None:
        self._identity = identity
        self._guard = participant.guard
        self._beat = beat
        self.events: list[happened.Event] = []
        self.rival: msg.MasterBeat | None = None
        self.incarnation = identity.incarnation
        refuse = Refusals(self._take_event)
        self._links = HostLinks(
            participant, f"master {identity.name}", identity.epoch, control.order_retry,
            self._take_event,
        )  # fmt: skip
        self.handoffs = HandoffEndpoint(
            participant, identity.name, identity.epoch, self._take_event, refuse
        )
        self._hearing = Hearing(participant, self._links, self._take_event, refuse)
        self._say(participant)
        self._services = MasterServices(
            participant, self._links, identity, queries,
            beat=beat, control=control, tell=self._take_event, refuse=refuse,
        )  # fmt: skip

    def _say(self, participant: Participant) -> None:
        node, path = participant.node, names.Names(participant.settings.namespace)
        topic = path(names.MASTER_BEAT)
        node.create_subscription(
            msg.MasterBeat, topic, participant.counted(self._take_beat), qos.BEAT
        )
        self._beats = node.create_publisher(msg.MasterBeat, topic, qos.BEAT)
        self._loads = node.create_publisher(msg.Event, path(names.MASTER_LOAD), qos.LOAD)
        self._load_at = 0.0
        self._oldest: list[float] = []

    def _take_event(self, event: happened.Event) -> None:
        self.events.append(event)

    def _take_beat(self, message: msg.MasterBeat) -> None:
        if message.incarnation != self._identity.incarnation:
            self.rival = message

    # --- what is heard -------------------------------------------------------------------

    def poll_readings(self) -> None:
        """Look at the readings, also when nothing else happens; called in every tick."""
        self._take_readings()
        self._oldest.append(self._links.ledger.ages(time.monotonic())[1])

    def _take_readings(self) -> None:
        self._guard.call(self._take_new_readings)

    def _take_new_readings(self) -> None:
        readings = self._hearing.poll_readings()
        if readings is not None:
            # Before all else: a usage must not be judged by readings that are older than it.
            self.events.insert(0, readings)

    def take_events(self) -> list[happened.Event]:
        """What happened since the last call, in order; decided by the newest readings there are."""
        if self.events and not isinstance(self.events[0], happened.ReadingsReceived):
            self._take_readings()
        events, self.events = self.events, []
        return events

    # --- what is said --------------------------------------------------------------------

    def reply(self, command: Reply) -> None:
        """Answer a request."""
        self._services.reply(command)

    def assign(self, command: Assign) -> None:
        """Keep an assignment for the answer to the host's request."""
        self._links.assign(command)

    def flush(self, journal: int) -> None:
        """Answer the open requests of hosts for which there are assignments.

        Args:
            journal: sequence of the newest record that is written.
        """
        self._links.flush(journal)

    def withdraw(self, command: Withdraw, now: float) -> None:
        """Take an assignment back, or order its end."""
        self._links.withdraw(command, now)

    def redeliver(self, command: Redeliver, now: float) -> None:
        """Order the start of an assignment that was fetched already."""
        self._links.redeliver(command, now)

    def order(self, command: Order, now: float) -> None:
        """Ask a slave for something; the answer, or none in time, comes back as an event."""
        self._links.order(command, now)

    def expire(self, now: float) -> None:
        """End what was not answered in time."""
        self._links.expire(now)

    def beat(self, uptime: float, unheard: Sequence[int], journal: int) -> None:
        """Say that the master lives, and now and then how it keeps up.

        Args:
            uptime: seconds.
            unheard: numbers of the hosts that it does not hear.
            journal: sequence of the newest record that is written.
        """
        identity = self._identity
        self._beats.publish(
            msg.MasterBeat(
                protocol_version=PROTOCOL_VERSION, name=identity.name, hostname=identity.hostname,
                pid=identity.pid, epoch=identity.epoch, incarnation=identity.incarnation,
                beat=self._beat(), uptime=uptime, journal=journal, unheard=list(unheard),
            )
        )  # fmt: skip
        if uptime - self._load_at >= _LOAD_EVERY:
            self._load_at = uptime
            self._say_load(uptime)

    def _say_load(self, uptime: float) -> None:
        """Publish what tells whether this master takes in all that its slaves say."""
        ledger = self._links.ledger
        hosts, _ = ledger.ages(time.monotonic())
        oldest, self._oldest = self._oldest, []
        facts = {
            "hosts": hosts, "cycles": ledger.cycles, "missed": ledger.missed,
            "cpu_s": time.process_time(), "oldest_reading_s": [round(age, 4) for age in oldest],
        }  # fmt: skip
        self._loads.publish(
            msg.Event(
                wall_time=time.time(), elapsed=uptime, kind="load", data=json.dumps(facts),
                message=f"{hosts} hosts are heard, {ledger.missed} of "
                f"{ledger.cycles + ledger.missed} cycles were missed, the oldest reading is "
                f"{max(oldest, default=0.0):.2f} s old",
            )
        )  # fmt: skip
