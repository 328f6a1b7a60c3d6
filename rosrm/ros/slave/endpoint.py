"""Slave endpoint: finds the master, registers, requests work, reports."""

from __future__ import annotations

import logging
import math
from array import array
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from enum import Enum
from typing import Final

from rclpy.duration import Duration

from rosrm import clocks
from rosrm.core.slave import events
from rosrm.core.slave.master_clock import BeatClock
from rosrm.core.slave.state import SlaveState
from rosrm.errors import Refused
from rosrm.extensions.plugin_calls import Plugin
from rosrm.keys.security import Member
from rosrm.model.devices import Device
from rosrm.model.traced_values import stamped_assignment
from rosrm.model.values import HostDescription, InstanceStatus, SnapshotReport
from rosrm.ros import convert, names, qos
from rosrm.ros.bounds import MOST_LETTERS
from rosrm.ros.control import Call, ControlClient, master_identity, version_refusal
from rosrm.ros.sealed import SealedEndpoints
from rosrm.ros.sealed_readings import reading_channel, seal_reading
from rosrm.ros.slave.journal_watermark import JournalWatermark, Watermark
from rosrm.ros.slave.reporter import Reporter
from rosrm.version import PROTOCOL_VERSION, __version__
from rosrm.wording import sendable
from rosrm_msgs import msg, srv

_log = logging.getLogger("rosrm.slave")

#: Seconds for one request to the master.
_PATIENCE: Final = 3.0
#: Seconds after which a long poll is repeated, because it may have been lost.
_POLL_AGAIN: Final = 30.0
#: The same for the first handshake and the first poll; then the interval grows. The first ones can
#: be lost, because DDS has not discovered the master yet, or because the services of a killed
#: master look ready until its DDS lease ends.
_FIRST_AGAIN: Final = 0.25
#: Factor by which the interval between handshakes grows. Otherwise the handshakes of a thousand
#: slaves that lost their master would delay the answers of the next one.
_GREET_GROWTH: Final = 4.0
#: Seconds between a refused request for work and the next one.
_ASK_AGAIN: Final = 0.2
#: Seconds for which registration is retried while the name is taken: the former run of this slave
#: may have been killed a moment ago.
_NAME_TAKEN: Final = 5.0
#: The same if that run left processes behind. They are not given up before a master with a long
#: `liveness.suspect` has noticed its end.
_NAME_TAKEN_BY_FORMER: Final = 60.0
#: Seconds for the last statuses to reach the master.
_ACK_PATIENCE: Final = 2.0
#: Missed beats after which a master counts as gone; and missed beats before another run is
#: accepted: of two masters at once the younger gives way, and a beat alone proves no master.
_MISSED_BEATS: Final = 10
_MISSED_BY_ANOTHER: Final = 3
#: Seconds after which the slave logs that the master receives none of its messages.
_SILENCE_LOGGED: Final = 5.0
#: Seconds between two reports of messages without a valid key, and the highest number in one.
_STRANGERS_EVERY: Final = 10.0
_MOST_STRANGERS: Final = 2**32 - 1
#: Seconds between two beats that no master exceeds.
_LONGEST_BEAT_PERIOD: Final = 3600.0


#: Seconds without an answer after which a master counts as one with other keys. The services of a
#: killed master look ready for a shorter time, until its DDS lease ends.
_IGNORED: Final = 25.0


class MasterLink(Enum):
    """State of the connection to the master."""

    SEARCHING = "searching"
    GREETING = "greeting"
    LISTENING = "listening"  # for a beat of the greeting master, which alone identifies its run
    REGISTERING = "registering"
    REGISTERED = "registered"


class SlaveEndpoint:
    """The slave's publishers, subscriptions and requests to its master.

    Args:
        state: instances of the slave; read-only here.
        take: takes events for the core.
        snapshots: returns all snapshots on this host.
        seen: newest journal records of the masters that this host knows.

    Attributes:
        description: of this host.
        link: state of the connection to the master.
        failure: reason to give up; "": there is none.
        cluster: name of the last master that greeted this slave; "" before the first one.
        epoch: newest known epoch of the master.
        failing: kind and name of each failing plugin on this host, with the reason; sent with the
            statuses. A probe is named by the resource that it reads.
    """

    def __init__(
        self, endpoints: SealedEndpoints[Member], description: HostDescription,
        state: SlaveState, *, take: Callable[[events.Event], None],
        snapshots: Callable[[], Sequence[SnapshotReport]] = tuple,
        seen: JournalWatermark | None = None,
    ) -> None:  # fmt: skip
        self._endpoints = endpoints
        self._master = endpoints.security.master
        self._state, self._take, self._snapshots = state, take, snapshots
        self.description = description
        self._seen = seen or JournalWatermark()
        self.link = MasterLink.SEARCHING
        self.failure = ""
        self.cluster = ""
        self.failing: dict[Plugin, str] = {}
        self.host_id = 0
        self.epoch = 0
        self._master_beat = 0
        self._beat_at = 0.0
        self._beat_period = 1.0
        self._greeting = srv.Handshake.Response()
        self._greeted_at = 0.0
        self._asked_at = 0.0
        self._greet_again = _FIRST_AGAIN
        self._beat_clock = BeatClock()
        self._newest_beat: msg.MasterBeat | None = None
        self._incarnation = 0  # of the master of this registration, complete or in progress
        self._registered_with = 0  # incarnation of the last master that accepted the registration
        self._taken_since: float | None = None
        self._waits_since: float | None = None
        self._leaves: Sequence[InstanceStatus] | None = None  # left running when the slave leaves
        self._poll: Call | None = None
        self._poll_at = 0.0
        self._poll_again = _FIRST_AGAIN
        self._status_sequence = 0
        self._silent_since = math.inf  # -inf: the silence is logged
        self._strangers = 0
        self._strangers_at = -math.inf
        self._unanswered_since = math.inf
        endpoints.refused = self._note_stranger
        participant = endpoints.participant
        self._control = ControlClient(participant, f"slave {description.name}")
        self._names = names.Names(participant.settings.namespace)
        self._join()

    def _join(self) -> None:
        endpoints, path, master = self._endpoints, self._names, self._master
        self._clients = {
            kind: endpoints.client(kind, path(name), master, first_contact=kind is srv.Handshake)
            for kind, name in (
                (srv.Handshake, names.HANDSHAKE),
                (srv.RegisterHost, names.REGISTER_HOST),
                (srv.RequestProcess, names.REQUEST_PROCESS),
                (srv.Leave, names.LEAVE),
            )
        }
        topic = path(names.RESOURCE_INFO)
        readings = endpoints.participant.node.create_publisher(
            msg.SealedReading, topic, qos.READING_OUT
        )
        channel, description = reading_channel(topic), self.description
        self._reporter = Reporter(
            lambda reading: readings.publish(seal_reading(master, channel, reading)),
            description.incarnation, description.period,
        )  # fmt: skip
        self._statuses, self._usages, self._snapshot_reports = (
            endpoints.publisher(kind, path(name), qos.STATUSES, master)
            for kind, name in (
                (msg.ProcessStatusBatch, names.PROCESS_STATUS),
                (msg.ProcessUsage, names.PROCESS_USAGE),
                (msg.SnapshotReports, names.SNAPSHOT_REPORTS),
            )
        )
        endpoints.follow(msg.MasterBeat, path(names.MASTER_BEAT), qos.BEAT_IN, self._take_beat)

    def _note_stranger(self, topic: str) -> None:
        """Count a message without a valid key for the next statuses."""
        del topic
        self._strangers = min(self._strangers + 1, _MOST_STRANGERS)

    def is_ignored(self, now: float) -> bool:
        """Return True if a discovered master has answered no handshake for `_IGNORED` seconds."""
        searches = self.link in (MasterLink.SEARCHING, MasterLink.GREETING)
        return searches and now - self._unanswered_since >= _IGNORED

    # --- finding the master --------------------------------------------------------------

    def advance(self, now: float) -> None:
        """Take the next step towards a registration; called in every cycle."""
        self._control.expire(now)
        if self._should_greet(now):
            if self._clients[srv.Handshake].service_is_ready():
                self._greet(now)
            else:
                self._unanswered_since = math.inf
        if self.link is MasterLink.LISTENING and now - self._greeted_at >= _PATIENCE:
            self.link = MasterLink.SEARCHING
        if self.link is MasterLink.REGISTERED and self._missed(_MISSED_BEATS, now):
            silence = now - self._beat_at
            keep = "; processes keep running" if self._leaves is None else ""
            self._lose_master(f"the master has been silent for {silence:.1f} s{keep}")
        is_due = self._strangers and now - self._strangers_at >= _STRANGERS_EVERY
        if is_due and self.link is MasterLink.REGISTERED:
            self._strangers_at = now
            self.publish_statuses((), complete=False)

    def _should_greet(self, now: float) -> bool:
        """Return True if a handshake is due: none was sent, or the newest got no answer in time."""
        if self.link is not MasterLink.GREETING:
            return self.link is MasterLink.SEARCHING
        return now - self._asked_at >= self._greet_again

    def _greet(self, now: float) -> None:
        if self.link is MasterLink.GREETING:
            self._greet_again = min(_GREET_GROWTH * self._greet_again, _PATIENCE)
        self.link = MasterLink.GREETING
        self._asked_at = now
        self._unanswered_since = min(self._unanswered_since, now)
        request = srv.Handshake.Request(
            protocol_version=PROTOCOL_VERSION, software_version=__version__, role="slave",
            name=self.description.name,
        )  # fmt: skip
        self._control.call(
            self._clients[srv.Handshake], request, now + _PATIENCE,
            lambda answer: self._take_greeting(answer, now),
        )  # fmt: skip

    def _take_greeting(self, answer: srv.Handshake.Response | None, asked_at: float) -> None:
        now = clocks.boot_time()
        if answer is not None:
            self._unanswered_since = math.inf
        if self.link is not MasterLink.GREETING:
            return  # another of the repeated requests was answered first
        if answer is None or now - asked_at >= _PATIENCE:  # this process was stopped
            if asked_at == self._asked_at:
                self.link = MasterLink.SEARCHING
            return
        fault = version_refusal(answer.protocol_version, f"the master on {answer.hostname}")
        if fault or not answer.accepted:
            self.failure = fault or answer.message
            return
        self.cluster = answer.master
        self._greeting, self._greeted_at = answer, now
        self._beat_clock.restart()
        self._note_beat(answer.beat, now)
        self.link = MasterLink.LISTENING
        self._register_if_known()

    def _register_if_known(self) -> None:
        """Register once a beat identifies the run of the master that greeted this slave."""
        beat = self._newest_beat
        if beat is None or master_identity(beat) != master_identity(self._greeting):
            return
        request = srv.RegisterHost.Request(
            envelope=self._control.envelope(self._master_beat, self._greeting.epoch),
            host=convert.host_to_msg(self.description),
            instances=[convert.status_to_msg(status) for status in self._state.statuses()],
            snapshots=[convert.snapshot_to_msg(one) for one in self._snapshots()],
            journal_seen=self._seen.of_former_run(self.cluster, beat.incarnation),
        )
        self._incarnation = beat.incarnation
        self._asked_at = clocks.boot_time()
        self.link = MasterLink.REGISTERING
        self._poll_at = 0.0
        self._control.call(
            self._clients[srv.RegisterHost], request, clocks.boot_time() + _PATIENCE,
            self._take_registration,
        )  # fmt: skip

    @property
    def is_registered(self) -> bool:
        """Return True if the master has registered this host."""
        return self.link is MasterLink.REGISTERED

    def _take_registration(self, response: srv.RegisterHost.Response | None) -> None:
        now = clocks.boot_time()
        if response is None or response.answer.code == "stale":
            self.link = MasterLink.SEARCHING
            return
        answer = response.answer
        if answer.code in ("journal", "failed"):
            self._wait_for_journal(answer.message, now)
            return
        self._waits_since = None
        if not answer.accepted:
            self._turned_down(answer, now)
            return
        if not 0.0 < response.beat_period <= _LONGEST_BEAT_PERIOD:
            raise Refused(f"the master sends a beat every {response.beat_period} s")
        self._taken_since = None
        self.host_id = response.host_id
        another = self._registered_with not in (0, self._incarnation)
        renumbers = another and answer.epoch <= self.epoch
        self._registered_with, self.epoch = self._incarnation, answer.epoch
        self._beat_period = response.beat_period
        self._beat_at = now
        self._poll_again = _FIRST_AGAIN
        self._reporter.begin(self.host_id, self._beat_period)
        self.link = MasterLink.REGISTERED
        self._take(events.ContactConfirmed(self._asked_at))
        self._take(events.Registered(answer.epoch, renumbers))
        greeting = self._greeting
        _log.info(
            "registered with master %s (pid %d on %s) as host %d",
            greeting.master, greeting.pid, greeting.hostname, self.host_id,
        )  # fmt: skip
        if self._leaves is not None:  # the former master was gone before it recorded this
            self._send_leave(self._leaves, lambda: None)

    def _wait_for_journal(self, why: str, now: float) -> None:
        """Retry while the master's journal stalls, and log the wait once."""
        self.link = MasterLink.SEARCHING
        if self._waits_since is None:
            self._waits_since = now
            _log.info("the master is not accepting hosts; retrying: %s", why)

    def _turned_down(self, answer: msg.Answer, now: float) -> None:
        """Retry for a while if the name is taken, as a former run of this slave may hold it."""
        if self._taken_since is None:
            self._taken_since = now
            if answer.code == "name_taken":
                _log.info(
                    "%s. Asking again for %g s, as that slave may have been killed a moment ago",
                    answer.message, self._patience(),
                )  # fmt: skip
        if answer.code != "name_taken" or now - self._taken_since >= self._patience():
            self.failure = answer.message
            return
        self.link = MasterLink.SEARCHING

    def _patience(self) -> float:
        found = any(not status.state.ended for status in self._state.statuses())
        return _NAME_TAKEN_BY_FORMER if found and not self.host_id else _NAME_TAKEN

    def set_devices(self, devices: tuple[Device, ...]) -> None:
        """Describe the devices of this host as they are now."""
        self.description = replace(self.description, devices=devices)
        self.publish_statuses((), complete=False)

    def describe_again(self, description: HostDescription) -> None:
        """Register again, with another description of the same run of this slave."""
        self.description = description
        if self.link is not MasterLink.SEARCHING:
            self._lose_master("the description of this host has changed; registering again")

    def _lose_master(self, reason: str) -> None:
        self.link = MasterLink.SEARCHING
        self._poll_at = 0.0
        self._newest_beat = None
        self._greet_again = _FIRST_AGAIN
        self._control.forget()
        self._take(events.MasterLost())
        _log.info("%s", reason)

    def _take_beat(self, beat: msg.MasterBeat, _run: bytes) -> None:
        if version_refusal(beat.protocol_version, "the master"):
            return  # the handshake reports the version mismatch
        now = clocks.boot_time()
        if self.link is MasterLink.REGISTERED and beat.incarnation != self._incarnation:
            if not self._missed(_MISSED_BY_ANOTHER, now):
                return
            self._lose_master(f"the master has started again (epoch {beat.epoch})")
        self._newest_beat = beat
        if self.link is MasterLink.SEARCHING:  # do not wait for the next cycle
            self.advance(now)
        if not self._is_of_master(beat) or self._beat_clock.is_ahead(beat.beat / 1e9, now):
            return
        self._endpoints.security.note_beat(beat.tickets_from)
        sent_at = self._note_beat(beat.beat, now)
        if self.link is MasterLink.REGISTERED:
            self._seen.note(Watermark(beat.journal, beat.incarnation, self.cluster))
        if self.link is MasterLink.REGISTERED:
            self._note_contact(now, sent_at, is_silent=self.host_id in beat.silent_hosts)
        if self.link is MasterLink.LISTENING:
            self._register_if_known()

    def _note_contact(self, now: float, sent_at: float, *, is_silent: bool) -> None:
        """Confirm the contact with the master, or log once that it receives nothing from here."""
        if not is_silent:
            self._silent_since = math.inf
            self._take(events.ContactConfirmed(sent_at))
            return
        before = self._silent_since
        self._silent_since = min(before, now)
        if before <= now - _SILENCE_LOGGED:
            self._silent_since = -math.inf
            if before > -math.inf:
                _log.info(
                    "the master receives no messages of this host: the network is cut, or the key "
                    "of %s was revoked or replaced (`rosrm key list` on the machine of the master)",
                    self._master.name,
                )  # fmt: skip

    def _is_of_master(self, beat: msg.MasterBeat) -> bool:
        """Return True if a beat is that of the master with which this slave speaks."""
        if self.link is MasterLink.LISTENING:
            return master_identity(beat) == master_identity(self._greeting)
        registers = self.link in (MasterLink.REGISTERING, MasterLink.REGISTERED)
        return registers and bool(beat.incarnation == self._incarnation)

    def _missed(self, beats: int, now: float) -> bool:
        """Return True if the master has been silent for longer than this number of beats."""
        return now - self._beat_at > beats * self._beat_period

    def _note_beat(self, beat: int, now: float) -> float:
        """Store a beat; return the time of its sending by this host's clock."""
        self._master_beat, self._beat_at = beat, now
        self._reporter.note_master(beat)
        return self._beat_clock.sent_at(beat / 1e9, now)

    # --- requesting work -----------------------------------------------------------------

    def ask(self, now: float) -> None:
        """Ask for work, unless a request is open already.

        When the request is renewed, the answer to the former one may be on its way. The slave
        takes that answer as well, because the master repeats assignments that were lost only
        after `control.order_retry`.
        """
        if now < self._poll_at or self.link is not MasterLink.REGISTERED:
            return
        self._poll_at = now + self._poll_again
        self._poll_again = min(2.0 * self._poll_again, _POLL_AGAIN)
        if self._poll is not None:
            self._poll.deadline = now + _PATIENCE
        request = srv.RequestProcess.Request(
            envelope=self._control.envelope(self._master_beat, self.epoch),
            host_id=self.host_id, incarnation=self.description.incarnation,
        )  # fmt: skip
        self._poll = self._control.call(
            self._clients[srv.RequestProcess], request, math.inf, self._take_work
        )

    def _take_work(self, response: srv.RequestProcess.Response | None) -> None:
        if response is None:
            return  # the request was renewed, and the former one was lost
        received = clocks.wall_time_ns()
        self._poll_at, self._poll_again = 0.0, _POLL_AGAIN
        answer = response.answer
        if not answer.accepted:
            self._poll_at = clocks.boot_time() + _ASK_AGAIN  # not in every round of the loop
            if answer.code in ("unknown", "stale"):
                self._lose_master(f"the master does not know this host any more: {answer.message}")
            return
        self.note_journal(response.journal, answer.epoch)
        try:
            work = tuple(
                stamped_assignment(convert.assignment_from_msg(one), slave_received=received)
                for one in response.assignments
            )
        except Refused as refusal:
            _log.info("an invalid assignment was refused: %s", refusal)
            return
        given_at = response.slave_beat / 1e9 if response.slave_beat else None
        self._take(events.AssignmentsReceived(work, given_at))

    def note_journal(self, journal: int, epoch: int) -> None:
        """Store the watermark of the journal that came with an assignment.

        An assignment of a former run of the master has another epoch, and its watermark is ignored.
        """
        if journal and epoch == self.epoch:
            self._seen.note(Watermark(journal, self._incarnation, self.cluster))

    # --- reports ---------------------------------------------------------------------------

    def publish_reading(
        self, usage: array[float], limit: array[float], present: int, stale: int, *,
        accepting: bool, processes: int,
    ) -> None:  # fmt: skip
        """Publish utilisation and limits of this host, fractions by slot, once in every cycle.

        A reading without news is sent with a later cycle (`rosrm.ros.slave.reporter`).
        """
        if self.link is MasterLink.REGISTERED:
            facts = (accepting, processes, present, stale, self._status_sequence)
            self._reporter.cycle(usage, limit, facts)

    def publish_statuses(self, statuses: Sequence[InstanceStatus], *, complete: bool) -> None:
        """Publish statuses of instances."""
        if self.link is not MasterLink.REGISTERED:
            return  # the next registration includes all statuses
        self._status_sequence += 1
        self._statuses.publish(
            msg.ProcessStatusBatch(
                protocol_version=PROTOCOL_VERSION, host_id=self.host_id,
                incarnation=self.description.incarnation, sequence=self._status_sequence,
                complete=complete, strangers=self._strangers,
                statuses=[convert.status_to_msg(one) for one in statuses],
                failing=[
                    msg.PluginState(
                        kind=kind, name=name, state="failing",
                        reason=sendable(reason)[:MOST_LETTERS],
                    )
                    for (kind, name), reason in self.failing.items()
                ],
                devices=convert.devices_to_msg(self.description.devices),
            )
        )  # fmt: skip
        self._strangers = 0

    def publish_usage(
        self, numbers: Sequence[int], cpu: Sequence[float], memory: Sequence[int],
        others: Mapping[int, Sequence[float]],
    ) -> None:  # fmt: skip
        """Publish each instance's use: cores, bytes, other resources by slot; parallel sequences.

        The newest reading is sent first: the master reduces reservations by these usages, so its
        readings must already include that load.
        """
        if self.link is MasterLink.REGISTERED:
            self._reporter.publish()
            self._usages.publish(
                msg.ProcessUsage(
                    protocol_version=PROTOCOL_VERSION, host_id=self.host_id,
                    incarnation=self.description.incarnation, numbers=numbers, cpu=cpu,
                    memory=memory,
                    others=[
                        msg.ResourceUsage(slot=slot, amounts=amounts)
                        for slot, amounts in others.items()
                    ],
                )
            )  # fmt: skip

    def publish_snapshots(self, states: Sequence[SnapshotReport]) -> bool:
        """Publish all snapshots that this host holds; False: it is not registered."""
        if self.link is not MasterLink.REGISTERED:
            return False
        self._snapshot_reports.publish(
            msg.SnapshotReports(
                protocol_version=PROTOCOL_VERSION, host_id=self.host_id,
                incarnation=self.description.incarnation,
                snapshots=[convert.snapshot_to_msg(one) for one in states],
            )
        )  # fmt: skip
        return True

    def wait_until_received(self) -> None:
        """Wait until the last statuses are acknowledged: others are lost when this slave leaves."""
        if self.link is not MasterLink.REGISTERED:
            return
        if not self._statuses.wait_for_all_acked(Duration(seconds=_ACK_PATIENCE)):
            _log.info(
                "the master did not acknowledge the last statuses within %g s",
                _ACK_PATIENCE,
            )

    def leave(self, done: Callable[[], None], running: Sequence[InstanceStatus] = ()) -> None:
        """Report that this slave stops; `done` is called once, when the master knows or is silent.

        A master that this slave finds after that is informed as well.

        Args:
            running: all instances, if the slave leaves them running; (): it stops them.
        """
        self._leaves = running
        if self.link is MasterLink.REGISTERED:
            self._send_leave(running, done)
        else:
            done()

    def _send_leave(self, running: Sequence[InstanceStatus], done: Callable[[], None]) -> None:
        request = srv.Leave.Request(
            envelope=self._control.envelope(self._master_beat, self.epoch),
            host_id=self.host_id, incarnation=self.description.incarnation,
            left_running=[convert.status_to_msg(status) for status in running],
        )  # fmt: skip
        self._control.call(
            self._clients[srv.Leave], request, clocks.boot_time() + 1.0, lambda _: done()
        )
