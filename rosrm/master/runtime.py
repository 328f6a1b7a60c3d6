"""Main loop of the master: receive events, let the core decide, journal intents, execute."""

from __future__ import annotations

import contextlib
import json
import logging
import os
import socket
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

from rosrm import clocks
from rosrm.artifacts.store import ArtifactStore
from rosrm.config.placement import settings_of_chain
from rosrm.config.settings import ClusterConfig
from rosrm.core.master import events as happened
from rosrm.core.master.commands import (
    Assign,
    Command,
    PublishStateConfig,
    ReadSettings,
    Redeliver,
    Reply,
    SendOrder,
    Withdraw,
)
from rosrm.core.master.master_state import MasterState
from rosrm.core.master.recovery import journal_gap, restore
from rosrm.core.master.reducer import step
from rosrm.core.master.state.hosts import HostCondition
from rosrm.core.master.state.process import Instance
from rosrm.errors import JournalBlocked, Refused
from rosrm.extensions.contracts import CheckpointPolicy, MigrationStrategy
from rosrm.extensions.declared_fields import Declared
from rosrm.extensions.placement import PlacementPlugins
from rosrm.extensions.plugin_deadline import Deadlines
from rosrm.extensions.process_state import ProcessState
from rosrm.extensions.time_limit import CALL_LIMIT
from rosrm.journal.errors import unreadable
from rosrm.journal.sqlite import SqliteJournal
from rosrm.keys.finding import master_security
from rosrm.master.diagnostics import DiagnosticsFeed
from rosrm.master.grants_watch import GrantsWatch
from rosrm.master.journal_stall import JournalStall
from rosrm.master.journal_writer import JournalLate, JournalWriter
from rosrm.master.queries import MasterQueries
from rosrm.master.recorder import Recorder
from rosrm.master.settings_reload import SettingsReload
from rosrm.model.event_kinds import EventKind
from rosrm.model.records import Intent, Record, StoredRecord
from rosrm.model.rows import PluginRow
from rosrm.recording.reader import TABLES, Header
from rosrm.ros.master.artifacts import ArtifactServices
from rosrm.ros.master.diagnostics import open_diagnostics
from rosrm.ros.master.endpoint import MasterEndpoint
from rosrm.ros.master.request_socket import RequestSocket
from rosrm.ros.master.search import ASK_EVERY, MasterSearch
from rosrm.ros.master.services import MasterIdentity
from rosrm.ros.participant import Participant
from rosrm.ros.sealed import SealedEndpoints
from rosrm.runtime import durable
from rosrm.runtime.bootstrap import end_start, handle_signals
from rosrm.runtime.state_lock import only_one
from rosrm.runtime.worker import Worker
from rosrm.version import __version__
from rosrm.wording import counted, listed, one_line, signal_name

_log = logging.getLogger("rosrm.master")

#: Period of the tick in seconds, which checks readings and deadlines. The cost of a tick does not
#: depend on the number of readings (docs/decisions/0014).
_TICK: Final = 0.05
#: Seconds between two restorations of the state of the process.
_RESTORE_PERIOD: Final = 1.0
#: Least seconds to the tick at which the lease of a host ends.
_SOON: Final = 0.005
#: Seconds for the discovery of another running master, from the creation of the participant.
_DISCOVERY: Final = 1.0
#: Least seconds of these for the answer of that master to a handshake.
_ANSWER: Final = 0.5
#: Seconds within which two starts of masters count as simultaneous.
_AT_ONCE: Final = 1.0
#: Seconds of plugin calls in one turn; beyond this limit the core's clock is set back by them.
_BLOCKED: Final = 0.5
#: Seconds between two attempts to write the journal during a stall.
_TRY_AGAIN: Final = 0.5
_BOOT_ID: Final = Path("/proc/sys/kernel/random/boot_id")


class _LastRun(NamedTuple):
    """The previous run of this master, by its journal.

    Attributes:
        newest: sequence of the newest record.
        machine_rebooted: the machine has rebooted since, and the run recorded no end.
        epoch: of that run; 0: there was none.
    """

    newest: int
    machine_rebooted: bool
    epoch: int


class MasterRuntime:
    """One master.

    Args:
        config: checked settings.
        participant: of this master; the caller closes it.
        placement: the configured scoring policies and filters.
        strategies: the configured migration strategies.
        plugins: rows of `rosrm plugins` for the master's own plugins.
        checkpoint: the policy that places replicas; None: snapshots stay on their own hosts.
        declared: declarations of the offers of these plugins.

    Raises:
        Refused: another master runs on this domain, or on this state directory.
        JournalError: the journal cannot be used.
        ConfigError: a recording is configured and cannot be written.
    """

    def __init__(
        self,
        config: ClusterConfig,
        participant: Participant,
        placement: PlacementPlugins,
        strategies: dict[str, MigrationStrategy],
        plugins: Sequence[PluginRow],
        checkpoint: CheckpointPolicy | None,
        *,
        declared: Declared,
        reload: SettingsReload,
    ) -> None:
        self._config = config
        self._process = ProcessState()
        self._participant = participant
        self._reload = reload
        self._checkpoint = checkpoint
        self._declared = declared
        self._plugins = list(plugins)
        self._started = clocks.boot_time()
        self._stopping = ""
        self._recorder: Recorder | None = None
        self._held: JournalStall | None = None
        self._deadlines = Deadlines(min(CALL_LIMIT, config.liveness.lease / 4.0))
        self._from_threads: deque[Callable[[], None]] = deque()
        self._suspends = clocks.Suspends()
        self._behind = 0.0  # seconds that the core's clock is behind: its start and blocked time
        self._closing = contextlib.ExitStack()
        with contextlib.ExitStack() as opened:
            lock = opened.enter_context(
                only_one(config.state, "master", code="second_master", remedy="another `state:`")
            )
            path = config.state / "journal.sqlite"
            self._journal = SqliteJournal(
                path, sync=config.journal.sync, keep_events=config.journal.keep_events,
                keep_bytes=config.journal.keep_bytes,
            )  # fmt: skip
            self._writer = JournalWriter(self._journal, path)
            opened.callback(self._close_journal, lock)
            # From here on Ctrl-C causes an orderly shutdown; before, it ends the process at once.
            handle_signals(self._stop, self._reload.hang_up)
            opened.callback(self._reload.close)
            security = master_security(config.security)
            self._endpoints = SealedEndpoints(participant, security)
            self._grants = GrantsWatch(security)
            last, begun = self._last_run(), self._now()
            self._state = self._new_state(placement, strategies, last.epoch + 1)
            self._endpoint = self._new_endpoint()
            search = MasterSearch(self._endpoints, self._endpoint)
            self._search_once(search)
            # During the restore, the first answers arrive.
            self._restore(begun)
            self._refuse_second(search)
            opened.callback(self._end_record)
            self._begin_run(last, begun)
            self._behind = self._now() - begun  # nothing was decided in that time
            search.end()
            opened.enter_context(RequestSocket(self._endpoints))
            self._diagnostics = self._new_diagnostics()
            self._closing = opened.pop_all()

    def _search_once(self, search: MasterSearch) -> None:
        """Send a beat, and ask all other masters for a handshake."""
        now = self._now()
        self._beat(now)
        search.ask(now)

    def _refuse_second(self, search: MasterSearch) -> None:
        """Wait until the search for another master ends; raise `Refused` if there is one."""
        hosts = self._state.hosts.by_name.keys()
        ask_at = now = self._now()
        deadline = max(now + _ANSWER, self._participant.created_at + _DISCOVERY)
        while not search.has_ended(hosts) and now < deadline:
            if now >= ask_at:
                ask_at = now + ASK_EVERY
                self._search_once(search)
            self._participant.spin(max(0.0, min(ask_at, deadline) - now))
            now = self._now()
        first = search.found
        if first is not None:
            reason = (
                f"a master runs already on {self._config.ros.describe()}: {first.master!r}, pid "
                f"{first.pid} on {first.hostname}. Stop it first, or give this one another domain"
            )
            search.refuse_registrations(reason)
            raise Refused(reason, "second_master")

    def _close_journal(self, lock: int) -> None:
        if not self._writer.close():
            # Its last write may still succeed. The next master must not begin before the end of
            # this process, which releases the lock.
            os.dup(lock)

    def _new_state(
        self, placement: PlacementPlugins, strategies: dict[str, MigrationStrategy], epoch: int
    ) -> MasterState:
        """Return a state without hosts and processes."""
        state = MasterState(
            self._config.core(), placement, strategies, epoch, declared=self._declared
        )
        state.plugins.limit = self._deadlines
        state.chain_of = self._reload.chains
        state.scoring = state.scoring_in_force = settings_of_chain(self._config)
        state.wall, state.boot = clocks.wall_time(), _boot()
        state.replication.policy = self._checkpoint
        state.replication.policy_name = self._config.checkpoint.policy or ""
        return state

    def _restore(self, now: float) -> None:
        """Restore the state of the former run; this changes nothing in the journal."""
        try:
            restore.restore(self._state, self._journal.intents, now)
        except (AttributeError, KeyError, TypeError, ValueError) as fault:
            raise unreadable(self._config.state / "journal.sqlite", fault) from fault

    def _begin_run(self, last: _LastRun, now: float) -> None:
        """Write the start of this run to the journal, before any decision of it."""
        state = self._state
        journal_gap.begin(state, last.newest, now, machine_rebooted=last.machine_rebooted)
        started = f"master {self._config.name} started, epoch {state.epoch}"
        # Durable: otherwise the next master would not notice that it lost this run.
        self._writer.write_durably(
            [Record(EventKind.MASTER_STARTED, message=started)],
            # Both in one group, because from the boot id alone the next master cannot tell which
            # hosts this one waited for.
            [
                Intent("cluster", "epoch", {"epoch": state.epoch, "boot": _boot()}),
                journal_gap.intent(state),
            ],
            while_waiting=self._stay_in_contact,
        )
        self._record_from(state, now)

    def _stay_in_contact(self) -> None:
        """Send a beat and take what has arrived, before the loop runs."""
        self._beat(self._now())
        self._participant.spin(0.0)

    def _last_run(self) -> _LastRun:
        known = self._journal.intents("cluster").get("epoch", {"epoch": 0})
        last = self._journal.records(newest=1)
        stopped = not last or last[0].record.kind is EventKind.MASTER_STOPPED
        rebooted = not stopped and known.get("boot", _boot()) != _boot()
        return _LastRun(self._journal.last_sequence, rebooted, int(known["epoch"]))

    def _record_from(self, state: MasterState, now: float) -> None:
        """Begin the recording of this run, if configured, with the intents that were restored."""
        wanted, config = self._config.record, self._config
        if wanted.directory == Path():
            return
        intents = {table: self._journal.intents(table) for table in TABLES}
        gap = {"newest": state.journal_gap.newest, "fell": state.journal_gap.machine_rebooted}
        intents["cluster"] = {**intents["cluster"], "tail": gap}
        header = Header(
            __version__, config.name, json.loads(config.to_json()), state.epoch, now, intents
        )
        self._recorder = Recorder(wanted.directory, header, wanted.max_size, wanted.keep)
        _log.info("recording into %s", self._recorder.path)

    def _end_record(self) -> None:
        if self._recorder is not None:
            self._recorder.close(f"the master stopped: {self._stopping or 'it failed'}")

    def _new_endpoint(self) -> MasterEndpoint:
        identity = MasterIdentity(
            self._config.name, socket.gethostname(), os.getpid(), self._state.epoch,
            int.from_bytes(os.urandom(7), "big") | 1,
        )  # fmt: skip
        control, artifacts = self._config.control, self._config.artifacts
        store = ArtifactStore(self._config.state / "artifacts", artifacts.max_size)
        self._artifacts = ArtifactServices(
            self._endpoints, store, Worker("artifacts", self._post),
            keep=self._used_artifacts, max_rate=artifacts.max_rate,
        )  # fmt: skip
        reading = MasterQueries(
            self._config.name, self._state, self._journal, self._plugins,
            uptime=lambda: self._now() - self._started,
            core_now=lambda: self._core_now(self._now()),
            trouble=self._trouble,
            has_artifact=store.has,
        )  # fmt: skip
        return MasterEndpoint(self._endpoints, identity, reading, control)

    def _new_diagnostics(self) -> DiagnosticsFeed | None:
        topic = open_diagnostics(self._participant) if self._config.diagnostics else None
        return None if topic is None else DiagnosticsFeed(self._state, self._config.name, *topic)

    def _trouble(self) -> str:
        """Return why the master accepts no new work; "" if it does."""
        return self._held.refusal if self._held is not None and self._held.refuses else ""

    def _now(self) -> float:
        return clocks.boot_time()

    def _used_artifacts(self) -> frozenset[str]:
        """Return the digests of the artifacts of all processes, kept versions and modes."""
        applications = self._state.applications.values()
        kept = [one for known in applications for one in known.versions.values()]
        specs = [known.spec for known in self._state.processes.values()]
        specs += [spec for version in kept for spec in version.specs.values()]
        specs += [
            spec for mode in self._state.modes.known.values()
            for target in mode.targets for spec in target.specs
        ]  # fmt: skip
        return frozenset(one.digest for spec in specs for one in spec.artifacts)

    def _post(self, call: Callable[[], None]) -> None:
        """Schedule a call in the loop; may be called from any thread."""
        self._from_threads.append(call)
        with contextlib.suppress(Exception):  # the participant may be closed already
            self._participant.wake()

    # --- the loop ------------------------------------------------------------------------

    def run(self) -> int:
        """Serve until a signal to stop; returns the exit code."""
        end_start()
        self._process.keep_own()
        with self._closing:
            with durable.lease_kept_here():
                self._serve()
            self._participant.guard.call(self._process.restore)  # so that the log has the end
            self._say_stopped()
        return 1 if self._stopping.startswith("refused") else 0

    def _serve(self) -> None:
        next_tick = next_beat = next_restore = self._now()
        while not self._stopping:
            self._participant.spin(max(0.0, next_tick - self._now()))
            while self._from_threads:
                self._participant.guard.call(self._from_threads.popleft())
            now = self._now()
            self._deadlines.begin_turn()
            self._reload.chains.begin_turn()
            self._leave_out_suspend()
            if now >= next_tick:
                next_tick = now + _TICK
                self._tick(now)
            if now >= next_beat:
                next_beat = now + self._config.control.beat_period
                self._beat(now)
            if now >= next_restore:  # what a plugin has changed in a thread
                next_restore = now + _RESTORE_PERIOD
                self._participant.guard.call(self._process.restore)
            self._take_in(now)
            next_tick = min(next_tick, now + self._until_loss(now))
            if self._diagnostics is not None:
                self._diagnostics.advance(now, self._core_now(now), self._trouble())
            self._endpoint.load.note_turn(self._now() - now)

    def _beat(self, now: float) -> None:
        self._endpoint.beat(
            now - self._started, self._state.hosts.silent_hosts(), self._journal.last_sequence
        )

    def _until_loss(self, now: float) -> float:
        """Return the seconds until a silent host is lost, for a tick at that moment."""
        return max(_SOON, self._state.next_loss - self._core_now(now))

    def _say_stopped(self) -> None:
        try:
            message = f"master stopped: {self._stopping}"
            record = Record(EventKind.MASTER_STOPPED, message=message)
            self._writer.write_last(record, self._now() - self._started)
        except JournalLate as fault:
            _log.warning("%s; the last decisions were not executed", fault)
        except JournalBlocked as fault:
            _log.warning("%s; the last decisions were neither written nor executed", fault)
        _log.info(
            "master %s ended (%s); %s", self._config.name, self._stopping, what_runs(self._state)
        )

    def _stop(self, number: int, _frame: Any) -> None:
        self._stopping = self._stopping or signal_name(number)

    def _tick(self, now: float) -> None:
        self._endpoint.events += self._reload.poll()
        if self._grants.has_changed(now):
            self._endpoint.shut_revoked()
        self._endpoint.poll_readings()
        self._endpoint.links.expire(now)
        self._artifacts.advance(now)
        self._endpoint.events.append(happened.TimePassed())
        self._endpoint.rivals.expire(now)
        rival = self._endpoint.rivals.take_found()
        if rival is not None:
            self._judge_rival(rival, now)

    def _judge_rival(self, rival: Any, now: float) -> None:
        """Stop this master if it is the younger one of two.

        For two simultaneous starts the uptimes are ambiguous, so the incarnations decide.
        """
        older_by = now - self._started - rival.uptime
        if abs(older_by) < _AT_ONCE:
            older_by = self._endpoint.incarnation - rival.incarnation
        if not older_by <= 0.0:  # also for a rival whose uptime is no number
            return
        reason = (
            f"refused: a master runs already: {rival.name!r}, pid {rival.pid} on {rival.hostname}"
        )
        _log.error(reason)
        self._stopping = reason

    def _take_in(self, now: float) -> None:
        """Pass all received events to the core in order, and execute its commands as a group."""
        if self._held is not None and not self._end_stall(self._held, now):
            self._held.take(
                self._state, self._endpoint.take_events(), self._endpoint.services.reply, now
            )
            return
        self._state.wall = clocks.wall_time()
        core_now, spent = self._core_now(now), self._deadlines.spent
        self._endpoint.poll_first_readings()
        while self._held is None and (events := self._take_events()):
            commands: list[Command] = []
            for event in events:
                begun = self._now()
                decided = step(self._state, event, core_now)
                if decided:
                    self._endpoint.load.note_decision(self._now() - begun)
                if self._recorder is not None:
                    self._recorder.note(event, core_now, self._state.wall, decided)
                commands += decided
            if commands:
                self._carry_out(commands, now)
        if self._held is None:
            self._leave_out_blocked(self._deadlines.spent - spent)

    def _take_events(self) -> list[happened.Event]:
        return self._endpoint.take_events(queued=len(self._state.queue) > 0)

    def _leave_out_blocked(self, blocked: float) -> None:
        """Set the core's clock back by the seconds for which plugins blocked the master.

        The master received no answer in that time, so the time must not count for the time-out of a
        step.
        """
        if blocked > _BLOCKED:
            self._behind += blocked

    def _leave_out_suspend(self) -> None:
        """Set the core's clock back by the seconds in which this machine was suspended.

        The master received nothing in that time, so no host was silent, and no step was late. A
        host that lost the master fences by its own clock. Jobs end by the run times of their hosts.
        """
        slept = self._suspends.new()
        if not slept:
            return
        if self._held is None:  # else the end of the stall sets the clock
            self._behind += slept
        _log.info("this machine was suspended for %.1f s", slept)

    def _carry_out(self, commands: Sequence[Command], now: float) -> None:
        self._endpoint.links.decided_at = clocks.wall_time_ns()
        try:
            stored = self._write(commands)
        except JournalBlocked as fault:
            self._held = JournalStall(commands, fault, now, self._core_now(now), now)
            return
        self._act_on(commands, stored, now)

    def _end_stall(self, held: JournalStall, now: float) -> bool:
        """Return True after the commands of a journal stall have become durable."""
        length = now - held.since
        back = Record(
            EventKind.JOURNAL_BACK,
            message=f"for {length:.1f} s nothing was decided: {held.fault.public}",
            facts={"seconds": round(length, 1)},
        )  # fmt: skip
        try:
            if held.is_late:
                stored = self._writer.outcome()
            elif now - held.tried >= _TRY_AGAIN:
                held.tried = now
                stored = self._write([back, *held.commands])
            else:
                return False
        except JournalBlocked as fault:
            held.fault = fault
            return False
        self._held, self._behind = None, now - held.core_now
        self._endpoint.load.note_write(length)
        self._endpoint.events[:0] = held.waiting()
        self._act_on(held.commands, stored, now)
        if held.refuses and not any(one.record.kind is EventKind.JOURNAL_BACK for one in stored):
            self._carry_out([back], now)
        return True

    def _core_now(self, now: float) -> float:
        return now - self._behind if self._held is None else self._held.core_now

    def _act_on(
        self, commands: Sequence[Command], stored: Sequence[StoredRecord], now: float
    ) -> None:
        """Execute commands that are durable now."""
        # Messages to slaves go first, so that they can begin; replies to users and the log follow.
        # The reply to a registration opens the link that orders to this host need.
        replies = [command for command in commands if isinstance(command, Reply)]
        for reply in replies:
            if reply.host_id:
                self._endpoint.services.reply(reply)
        self._act(commands, now)
        self._endpoint.links.flush(self._journal.last_sequence)
        for reply in replies:
            if not reply.host_id:
                self._endpoint.services.reply(reply)
        if self._diagnostics is not None:
            self._diagnostics.note(one.record for one in stored)
        for one in stored:
            _log.info("%s", one_line(one.record.message))

    def _act(self, commands: Sequence[Command], now: float) -> None:
        links = self._endpoint.links
        for command in commands:
            if isinstance(command, Assign):
                links.assign(command)
            elif isinstance(command, SendOrder):
                links.order(command, now)
            elif isinstance(command, PublishStateConfig):
                self._endpoint.handoffs.publish(command)
            elif isinstance(command, Withdraw):
                links.withdraw(command, now)
            elif isinstance(command, Redeliver):
                links.redeliver(command, now)
            elif isinstance(command, ReadSettings):
                self._reload.start(command.request)

    def _write(self, commands: Sequence[Command]) -> Sequence[StoredRecord]:
        """Write the records and intents among the commands as one group."""
        records = [command for command in commands if isinstance(command, Record)]
        intents = [command for command in commands if isinstance(command, Intent)]
        if not records and not intents:
            return ()
        begun = self._now()
        try:
            return self._writer.write(records, intents, begun - self._started)
        finally:
            self._endpoint.load.note_write(self._now() - begun)


def what_runs(state: MasterState) -> str:
    """Return a sentence that counts the processes that keep running, and those being stopped."""
    stopping: list[Instance] = []
    running = 0
    for instance in state.instances.values():
        if state.hosts.condition_of(instance.host) is HostCondition.LEFT:
            if instance.state is not None and not instance.state.ended:
                stopping.append(instance)
        else:
            running += instance.is_running
    phrases = []
    if stopping:
        hosts = sorted({instance.host.name for instance in stopping})
        slaves = f"slave{'s' * (len(hosts) > 1)} of {listed(hosts)}"
        count = counted(len(stopping), "process is", "processes are")
        phrases.append(f"{count} still being stopped by the {slaves}")
    if running or not stopping:
        phrases.append(f"{counted(running, 'process keeps', 'processes keep')} running")
    if running:
        phrases.append("start the master again to manage them")
    return "; ".join(phrases)


def _boot() -> str:
    """Return the boot id of this machine, which changes at each boot; "" if unknown."""
    try:
        return _BOOT_ID.read_text().strip()
    except OSError:
        return ""
