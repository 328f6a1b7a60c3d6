"""The master's link to each slave: pending orders and assignments, and the slave's newest beat.

A slave judges the age of an order by its own clock. So the master cannot send orders before it has
received the slave's first beat, and queues them until then. An order also waits until DDS has
discovered the slave's service, because it would be lost otherwise.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Final

from rosrm import clocks
from rosrm.core.master import events as happened
from rosrm.core.master.commands import Assign, OrderId, Redeliver, SendOrder, Withdraw
from rosrm.errors import Refused
from rosrm.keys.security import Authority, Peer
from rosrm.model.links import LinkPeer
from rosrm.model.orders import (
    FenceInstance,
    MeasureLinks,
    Order,
    StartInstance,
    StopInstance,
    seconds_of,
)
from rosrm.model.traced_values import stamped_assignment
from rosrm.model.values import Assignment, HostDescription, InstanceId
from rosrm.ros import convert, names
from rosrm.ros.control import ControlClient, accepted, version_refusal
from rosrm.ros.master.reading_stats import ReadingStats
from rosrm.ros.orders import order_to_msg, start_to_msg
from rosrm.ros.sealed import SealedClient, SealedEndpoints
from rosrm.ros.sealed_readings import RegisteredSlave, reading_channel
from rosrm_msgs import srv

_log = logging.getLogger("rosrm.master")

#: Most orders and requests of one slave that wait for its next reading, and most introductions to
#: it, which users can request in any number.
_MOST_DEFERRED: Final = 1000
_MOST_INTRODUCTIONS: Final = 100
#: Seconds after a registration in which DDS discovers the service of a slave, if it does at all.
#: Later orders skip the check, in which rmw searches the endpoints of all hosts (4 ms for 1,000).
_DISCOVERY: Final = 30.0
#: Seconds after a registration during which the master polls for the first reading of the slave.
_FIRST_READING: Final = 1.0


@dataclass(frozen=True, slots=True)
class _Deferred:
    """An order for a slave, a request from it or an introduction to it that waits for a reading.

    Attributes:
        deadline: monotonic seconds.
        send: carries it out.
        done: called with None when the deadline has passed.
        starts: the instance that it starts; None: it starts none.
    """

    deadline: float
    send: Callable[[], None]
    done: Callable[[None], None] = lambda _: None
    starts: InstanceId | None = None


@dataclass(slots=True)
class HostLink:
    """Pending orders and assignments of one slave.

    Attributes:
        slave: the registered slave; None: its key was revoked.
        incarnation: of the run that registered last; messages of a former run are ignored.
        is_discovered: since the registration or the last silence of the slave, DDS has discovered
            its service, or `_DISCOVERY` has passed.
        searched_from: monotonic seconds of that registration or silence.
        deferred: orders and requests of it that wait for its first beat.
        introductions: introductions to it that wait for its first beat.
        outbox: assignments that wait for its request for work.
        poll: answers its open request; None: none is open.
        forget_poll: removes the open request from those that the master may still refuse.
    """

    host_id: int
    slave: RegisteredSlave | None
    control: SealedClient
    incarnation: int
    is_discovered: bool = False
    searched_from: float = -math.inf
    deferred: list[_Deferred] = field(default_factory=list)
    introductions: list[_Deferred] = field(default_factory=list)
    outbox: list[Assignment] = field(default_factory=list)
    poll: Callable[[Any], None] | None = None
    forget_poll: Callable[[], None] = lambda: None

    def is_of(self, sender: Peer) -> bool:
        """Return True if a sender is the slave of this host."""
        return self.slave is not None and sender.grant == self.slave.peer.grant

    def take_waiting(self) -> list[_Deferred]:
        """Remove and return all that waits for a reading, the orders first."""
        waiting = self.deferred + self.introductions
        self.deferred, self.introductions = [], []
        return waiting

    def take_late(self, now: float) -> list[_Deferred]:
        """Remove and return what has waited until its deadline."""
        late = [one for one in self.deferred + self.introductions if now >= one.deadline]
        self.deferred = [one for one in self.deferred if now < one.deadline]
        self.introductions = [one for one in self.introductions if now < one.deadline]
        return late

    def drop_start(self, instance: InstanceId) -> None:
        """Drop a waiting start of an instance that is stopped now; otherwise it would run first."""
        dropped = [one for one in self.deferred if one.starts == instance]
        self.deferred = [one for one in self.deferred if one.starts != instance]
        for one in dropped:
            one.done(None)

    def search(self) -> None:
        """Require that DDS discovers the slave's service before the next order."""
        self.is_discovered, self.searched_from = False, clocks.boot_time()

    def close_poll(self) -> None:
        """Close the open request: it is answered, or its answer can reach no slave."""
        self.forget_poll()
        self.poll, self.forget_poll = None, lambda: None


class HostLinks:
    """The links to all slaves that have registered.

    Args:
        sender: of the orders, for messages.
        order_timeout: seconds beyond an order's own time for its answer.
        handle: receives the events.

    Attributes:
        decided_at: unix time of the newest decision, ns, for the traces of starts.
        slave_of: returns the slave of a host; None: it has not registered, or its key was revoked.
            Called for each reading, so it reads one dictionary.
    """

    def __init__(
        self, endpoints: SealedEndpoints[Authority], sender: str, epoch: int, order_timeout: float,
        handle: Callable[[happened.Event], None],
    ) -> None:  # fmt: skip
        self._endpoints = endpoints
        self._epoch = epoch
        self._order_timeout = order_timeout
        self._handle = handle
        self._names = names.Names(endpoints.participant.settings.namespace)
        self._readings = reading_channel(self._names(names.RESOURCE_INFO))
        self._client = ControlClient(endpoints.participant, sender)
        self._links: dict[int, HostLink] = {}
        self._slaves: dict[int, RegisteredSlave] = {}
        self.slave_of: Callable[[int], RegisteredSlave | None] = self._slaves.get
        # Of a thousand links few have pending work, so only those are checked.
        self._waiting: set[int] = set()
        self._with_work: set[int] = set()
        self._first_readings_until = -math.inf
        self.reading_stats = ReadingStats()
        self.decided_at = 0

    # --- registered slaves ---------------------------------------------------------------

    def find(self, host_id: int, incarnation: int, sender: Peer) -> HostLink | None:
        """Return the link of a host, if the sender is its slave, in its last registered run."""
        link = self._links.get(host_id)
        if link is None or link.incarnation != incarnation or not link.is_of(sender):
            return None
        return link

    def is_slave_of(self, host_id: int, sender: Peer) -> bool:
        """Return True if the sender of a message is the slave of a host."""
        link = self._links.get(host_id)
        return link is not None and link.is_of(sender)

    def registered(self, host_id: int) -> HostLink | None:
        """Return the link of a registered slave; None: there is none with a valid key."""
        link = self._links.get(host_id)
        return None if link is None or link.slave is None else link

    def renew(self, host_id: int, description: HostDescription, peer: Peer, run: bytes) -> None:
        """Create or renew the link of a registered slave; clear the queue of a former run.

        Args:
            host_id: number of the host.
            description: of the host.
            peer: the slave.
            run: of the slave.
        """
        link = self._links.get(host_id)
        peer.run = run
        slave = RegisteredSlave.of(peer, run, self._readings, clocks.boot_time())
        if link is None or link.slave is None or link.slave.peer is not peer:
            link = self._new_link(host_id, description.name, slave)
            self._links[host_id] = link
        link.slave = self._slaves[host_id] = slave
        link.search()
        self._first_readings_until = link.searched_from + _FIRST_READING
        link.close_poll()
        if link.incarnation == description.incarnation:
            # The same run again: assignments that it has not fetched stay valid. But it was
            # unreachable, so an order with the last received beat would be stale.
            self.reading_stats.beat[host_id] = 0
            return
        link.incarnation = description.incarnation
        self.reading_stats.begin(host_id, description.incarnation)
        link.outbox.clear()
        self._shut(link)

    def _new_link(self, host_id: int, host: str, slave: RegisteredSlave) -> HostLink:
        former = self._links.get(host_id)
        if former is not None:  # the slave has another key now
            self._shut(former)
            former.control.destroy()
        path = self._names.of_host(host, names.CONTROL)
        control = self._endpoints.client(srv.ControlHost, path, slave.peer)
        return HostLink(host_id, slave, control, 0)

    def _shut(self, link: HostLink) -> None:
        """Close the open request, and end the orders and requests that wait for the slave."""
        link.close_poll()
        for order in link.take_waiting():
            order.done(None)

    def shut_revoked(self, has_access: Callable[[Peer], bool]) -> None:
        """Stop receiving from and sending to slaves without a valid key."""
        for link in self._links.values():
            if link.slave is not None and not has_access(link.slave.peer):
                link.slave = None
                del self._slaves[link.host_id]
                self._shut(link)
                self.reading_stats.forget(link.host_id)
                self._handle(happened.KeyRevoked(link.host_id, link.incarnation))

    def note_silent(self, host_ids: Iterable[int]) -> None:
        """Search again for the services of silent hosts, which DDS removes when its lease ends.

        Such a slave may not register again: it still receives beats if only its own messages are
        lost.
        """
        for host_id in host_ids:
            if host_id in self._links:
                self._links[host_id].search()

    def left(self, link: HostLink) -> None:
        """Close the open request of a slave that stops in an orderly way."""
        link.close_poll()
        self.reading_stats.forget(link.host_id)

    @property
    def awaits_first_readings(self) -> bool:
        """Return True if orders or requests wait for a slave that registered a moment ago."""
        return bool(self._waiting) and clocks.boot_time() < self._first_readings_until

    def reading_received(self, host_ids: Iterable[int]) -> None:
        """Send the orders that waited for readings of these hosts."""
        for host_id in self._waiting.intersection(host_ids) if self._waiting else ():
            self._waiting.discard(host_id)
            for order in self._links[host_id].take_waiting():
                order.send()

    def after_first_reading(
        self, link: HostLink, send: Callable[[], None], deadline: float = math.inf,
        done: Callable[[None], None] = lambda _: None, starts: InstanceId | None = None,
    ) -> None:  # fmt: skip
        """Call `send` now, or when the first beat of the slave has come, after what waits already.

        If the deadline (monotonic seconds) passes first, `done` is called with None instead.
        """
        if self.reading_stats.beat[link.host_id] and not link.deferred:
            send()
        else:
            self._wait(link, _Deferred(deadline, send, done, starts))

    def introduce_after_first_reading(
        self, link: HostLink, send: Callable[[], None], deadline: float,
        done: Callable[[None], None],
    ) -> None:  # fmt: skip
        """Do the same for an introduction to the slave; `done` is also called if too many wait."""
        if self.reading_stats.beat[link.host_id]:
            send()
        elif len(link.introductions) >= _MOST_INTRODUCTIONS:
            done(None)
        else:
            link.introductions.append(_Deferred(deadline, send, done))
            self._waiting.add(link.host_id)

    def _wait(self, link: HostLink, order: _Deferred) -> None:
        if len(link.deferred) >= _MOST_DEFERRED:
            link.deferred.pop(0).done(None)
        link.deferred.append(order)
        self._waiting.add(link.host_id)

    # --- work ----------------------------------------------------------------------------

    def assign(self, command: Assign) -> None:
        """Keep an assignment for `flush`."""
        assignment = stamped_assignment(
            command.assignment, decided=self.decided_at, journalled=clocks.wall_time_ns()
        )
        self._links[command.host_id].outbox.append(assignment)
        self._with_work.add(command.host_id)

    def open_poll(
        self, link: HostLink, respond: Callable[[Any], None], forget: Callable[[], None]
    ) -> None:
        """Open a slave's request for work; an earlier open one of it is never answered."""
        link.close_poll()
        link.poll, link.forget_poll = respond, forget
        if link.outbox:
            self._with_work.add(link.host_id)

    def flush(self, journal: int) -> None:
        """Send the assignments of hosts with an open request, with the journal's watermark.

        A single one is an order, because the answer to a request reaches the readers of all slaves.
        Several are one answer, because an order has one assignment, and a burst of orders can
        overflow the slave's socket.
        """
        while self._with_work:
            link = self._links[self._with_work.pop()]
            if not link.outbox or link.poll is None:
                continue
            batch, link.outbox = [self._as_sent(one) for one in link.outbox], []
            if len(batch) == 1 and self._is_discovered(link):
                self._start(link, batch[0], journal)
            else:
                self._answer_poll(link, link.poll, batch, journal)

    def _start(self, link: HostLink, assignment: Assignment, journal: int) -> None:
        """Order the start of an assignment; the request for work stays open."""
        request = start_to_msg(StartInstance(assignment), journal)
        deadline = clocks.boot_time() + self._order_timeout
        self._send(link, request, deadline, partial(_log_refusal, link, assignment))

    def _answer_poll(
        self, link: HostLink, respond: Callable[[Any], None], batch: Sequence[Assignment],
        journal: int,
    ) -> None:  # fmt: skip
        link.close_poll()
        respond(
            srv.RequestProcess.Response(
                answer=accepted(epoch=self._epoch), journal=journal,
                slave_beat=int(self.reading_stats.beat[link.host_id]),
                assignments=[convert.assignment_to_msg(one) for one in batch],
            )
        )  # fmt: skip

    def _as_sent(self, assignment: Assignment) -> Assignment:
        return stamped_assignment(self._keyed(assignment), assignment_sent=clocks.wall_time_ns())

    def withdraw(self, command: Withdraw, now: float) -> None:
        """Remove an assignment that was not yet fetched, or order its end."""
        link = self._links.get(command.host_id)
        waiting = link.outbox if link is not None else []
        kept = [one for one in waiting if one.instance != command.instance]
        if link is not None and len(kept) < len(waiting):
            link.outbox = kept
            self._handle(happened.AssignmentWithdrawn(command.instance))
            return
        self.order(command.if_fetched, now)

    def redeliver(self, command: Redeliver, now: float) -> None:
        """Order the start of an assignment, unless it waits to be fetched."""
        link, assignment = self._links.get(command.host_id), command.assignment
        if link is None or all(one.instance != assignment.instance for one in link.outbox):
            self.order(command.if_fetched, now)

    def _keyed(self, assignment: Assignment) -> Assignment:
        """Return an assignment with the key of its snapshots, if its process has snapshots.

        The key is added only here, so that neither the core nor the journal has keys.
        """
        if not assignment.has_snapshots:
            return assignment
        first = assignment.snapshots_from
        key = self._endpoints.security.snapshot_key(assignment.spec.name, first)
        return replace(assignment, state_key=key)

    # --- orders --------------------------------------------------------------------------

    def order(self, command: SendOrder, now: float) -> None:
        """Send an order to a slave; the answer, or its absence in time, becomes an event."""
        link = self._links.get(command.host_id)
        if link is None or link.slave is None:  # expected from the journal, or without a key
            why = "the host does not report"
            self._handle(happened.OrderAnswered.missing(command.order_id, why))
            return
        order, starts = command.order, None
        if isinstance(order, StartInstance):
            starts = order.assignment.instance
        elif isinstance(order, StopInstance | FenceInstance):
            link.drop_start(order.instance)
        request = order_to_msg(self._order_with_key(order, link))
        deadline = now + seconds_of(command.order) + self._order_timeout

        def done(response: srv.ControlHost.Response | None) -> None:
            self._handle(_order_answered(command.order_id, response))

        def send() -> None:
            if link.deferred or not self._is_discovered(link):  # in the order of the decisions
                self._wait(link, _Deferred(deadline, send, done, starts))
                return
            self._send(link, request, deadline, done)

        self.after_first_reading(link, send, deadline, done, starts)

    def _send(
        self, link: HostLink, request: srv.ControlHost.Request, deadline: float,
        done: Callable[[srv.ControlHost.Response | None], None],
    ) -> None:  # fmt: skip
        beat = int(self.reading_stats.beat[link.host_id])
        request.envelope = self._client.envelope(beat, self._epoch)
        self._client.call(link.control, request, deadline, done)

    def _is_discovered(self, link: HostLink) -> bool:
        """Return True if an order need not wait until DDS discovers the slave's service."""
        if not link.is_discovered:
            had_time = clocks.boot_time() - link.searched_from >= _DISCOVERY
            link.is_discovered = had_time or link.control.service_is_ready()
        return link.is_discovered

    def _order_with_key(self, order: Order, link: HostLink) -> Order:
        match order:
            case StartInstance(assignment):
                return StartInstance(self._keyed(assignment))
            case MeasureLinks(peers):
                return replace(order, peers=tuple(self._with_keys(peers, link)))
        return order

    def _with_keys(self, peers: Iterable[LinkPeer], link: HostLink) -> Iterator[LinkPeer]:
        """Yield the peers with a valid key, each with the key of the packets between both."""
        for peer in peers:
            other = self.slave_of(peer.host_id)
            if other is not None:
                key = self._endpoints.security.link_key_of(other.peer, link.host_id)
                yield replace(peer, key=key)

    def expire(self, now: float) -> None:
        """End the orders and requests that got no answer in time."""
        self._client.expire(now)
        for host_id in list(self._waiting):
            link = self._links[host_id]
            late = link.take_late(now)
            if not (link.deferred or link.introductions):
                self._waiting.discard(host_id)
            for order in late:
                order.done(None)


def _log_refusal(
    link: HostLink, assignment: Assignment, response: srv.ControlHost.Response | None
) -> None:
    """Log a refused START; the core repeats or withdraws it, as one without an answer."""
    if response is not None and link.slave is not None and not response.answer.accepted:
        _log.warning(
            "%s refused to start %s: %s",
            link.slave.peer.grant.principal, assignment.instance.process, response.answer.message,
        )  # fmt: skip


def _order_answered(
    order: OrderId, response: srv.ControlHost.Response | None
) -> happened.OrderAnswered:
    if response is None:
        return happened.OrderAnswered.missing(order)
    answer = response.answer
    fault = version_refusal(answer.protocol_version, "a slave")
    if fault:
        return happened.OrderAnswered(order, False, "version", fault)
    try:
        result = convert.json_object(response.result, "a result") if response.result else None
    except Refused as fault:
        return happened.OrderAnswered(order, False, happened.BAD_RESULT, str(fault))
    return happened.OrderAnswered(order, answer.accepted, answer.code, answer.message, result)
