"""Event loop of the supervisor: executes the commands of `rosrm.core.supervisor.reducer`.

Each round: read input, let the core decide, record, spawn a few, send statuses. A status is
recorded before it is sent, unless the disk takes nothing. A spawn is recorded as imminent before it
is tried. Threads call the files: one those of the logs, one those of the state (`file_thread`).
"""

from __future__ import annotations

import contextlib
import errno
import os
import selectors
import signal
import socket
import time
from collections import deque
from collections.abc import Callable, Sequence
from functools import partial
from typing import Final

from rosrm import clocks
from rosrm.core.supervisor import commands, events
from rosrm.core.supervisor.events import Event, Spawned, SpawnFailed
from rosrm.core.supervisor.instance import BACKOFF, STARTING, STOPPING
from rosrm.core.supervisor.reducer import SupervisorState
from rosrm.core.supervisor.rules import AdoptionRule, Key
from rosrm.model import start_trace
from rosrm.runtime import durable
from rosrm.runtime.file_thread import LATE, FileThread, NoAnswer
from rosrm.runtime.oom_score import score_of_children
from rosrm.runtime.signalling import send
from rosrm.supervisor import (
    adoption,
    endpoint,
    lease_file,
    messages,
    own_log,
    paths,
    procfs,
    spawn,
    takeover,
)
from rosrm.supervisor.boot_timer import BootTimer
from rosrm.supervisor.confinement import Confined, Confinement, Steps
from rosrm.supervisor.connection import Connection
from rosrm.supervisor.instance_groups import LimitRefused
from rosrm.supervisor.instance_record import InstanceRecord
from rosrm.supervisor.json_lines import ProtocolError
from rosrm.supervisor.log_calls import LogCalls
from rosrm.supervisor.logs import LogLimits
from rosrm.supervisor.process_tree import ProcessTrees, mark
from rosrm.supervisor.procfs import INSTANCE_MARK, SUPERVISOR_MARK
from rosrm.supervisor.spawn_error import SpawnError, is_transient
from rosrm.wording import listed, reason_of

#: Maximum number of starts before their exec at a time.
SPAWNS_A_ROUND: Final = 8
#: Seconds after which a start that waits for a path no longer counts among these.
LATE_START: Final = 0.5
#: Seconds between attempts to write the record while the disk is full.
RECORD_AGAIN: Final = 1.0
#: Most seconds of one wait: `epoll` takes 24.8 days at most, and raises an error for more.
LONGEST_WAIT: Final = 3600.0
#: Seconds without work after a failure of a part of the loop.
PAUSE_AFTER_FAULT: Final = 0.1
#: Seconds that the client has to read the last messages.
END_PATIENCE: Final = 1.0


class _Start:
    """A start whose process has not executed its program yet.

    Attributes:
        steps: its further course.
        attempt: the process.
        birth: of the process, in clock ticks.
        executes: pid of the process once it executes its program, until its end; 0: it does not.
        late: boot time from which the start counts as one that waits for a path.
        due: boot time at which the start fails.
    """

    def __init__(self, key: Key, program: spawn.Program, log: int) -> None:
        self.key, self.program, self.log = key, program, log
        self.late = clocks.boot_time() + LATE_START
        self.due = self.late - LATE_START + spawn.PATIENCE
        self.birth = 0
        self.executes = 0
        self.steps: Steps[Confined]
        self.attempt: spawn.Attempt


class Server:
    """The supervisor of one state directory.

    Args:
        state: absolute path of the directory.
        listener: socket for clients.
        limits: of the logs.
        files: soft limit of open descriptors of each process; None: that of the supervisor.

    Attributes:
        disk: thread of the state directory.
    """

    def __init__(
        self, state: str, listener: socket.socket, limits: LogLimits, files: int | None = None
    ) -> None:
        self._state = state
        self._listener = listener
        self._files = files
        self._selector = selectors.DefaultSelector()
        self._timer: BootTimer | None = None
        self._core = SupervisorState()
        self._suspends = clocks.Suspends()
        self._confinement = Confinement(state)
        self._groups = self._confinement.groups
        self._starts: dict[int, _Start] = {}  # by pid, before the exec
        self._trees = ProcessTrees(
            state, self._selector, self._happened, self._groups, self._reaped,
            lambda: {pid: start.key for pid, start in self._starts.items()},
        )  # fmt: skip
        self.disk = FileThread(state, report=own_log.write_fault)
        self._record = InstanceRecord(state, self.disk)
        self._last_contact = lease_file.LastContact(state, self.disk)
        self._logs = LogCalls(state, limits, self._core.instances)
        self._null = _open_null()
        self._launches: dict[Key, messages.Launch] = {}
        self._environments: dict[str, dict[str, str]] = {}
        self._notes: list[str] = []
        self._spawns: deque[Key] = deque()
        self._stuck: dict[int, tuple[str, str]] = {}  # killed before the exec: process, its step
        self._prepared: Key | None = None
        self._ended: list[Key] = []  # with control groups that are still to be removed
        self._unsent: list[bytes] = []
        self._first_starts: dict[Key, messages.Status] = {}  # unsent statuses before the first run
        self._client: Connection | None = None
        self._served = False
        self._leaving = False

    def run(self) -> None:
        """Serve until the shutdown is complete, or until no instance and no client is left.

        Ended instances stay in the record; the next client to connect starts another supervisor.
        """
        self._watch(self._listener, self._accept)
        self._watch_signals()
        self._take_over()  # unguarded: half of it could start processes twice
        with durable.lease_kept_here():
            while True:
                _guarded(self._round)
                if self._leaving:
                    break
                self._take_in(self._timeout())
        self._leave()

    def _take_in(self, timeout: float | None) -> None:
        """Handle the events that arrive within `timeout` seconds; None: wait for the first."""
        for key, _ in self._selector.select(timeout):
            # A call may close the descriptor of a later event, such as the report of a start whose
            # end was noticed first. Its number may even belong to another descriptor by now.
            # Not looked up by `fileobj`: a connection that is closed by now has no descriptor.
            if self._selector.get_map().get(key.fd) is key:
                _guarded(key.data)

    def _round(self) -> None:
        """Do everything that is due, without waiting; no part needs the success of another one."""
        if slept := self._suspends.new():
            self._happened(events.Slept(slept))
        if self._is_due():
            # After a SIGSTOP of this process: messages that came in time count first.
            self._take_in(0.0)
        if self._is_due():
            self._happened(events.TimePassed())
        now = clocks.boot_time()
        for look in (self._logs.look, self._trees.look, self._groups.look, self._abandon_late):
            _guarded(look, now)
        _guarded(self._spawn_some)
        _guarded(self._remove_groups)
        if self._record.is_large():
            _guarded(self._rewrite_record)
        self._record.flush()
        self._report()
        _guarded(self._prepare_held)
        for disk in (self.disk, self._logs.disk):
            disk.pass_on()
        if self._served and self._client is None and self._core.idle:
            self._leaving = True

    def _is_due(self) -> bool:
        deadline = self._core.deadline()
        return deadline is not None and deadline <= clocks.boot_time()

    def _timeout(self) -> float | None:
        late = self._late_disk()
        if self._spawns and self._room_for_starts() and late is None:
            return 0.0
        parts = (self._core, self._logs, self._trees, self._groups)
        deadlines = [part.deadline() for part in parts]
        if self._spawns and late is not None:
            deadlines.append(clocks.boot_time() + LATE)
        if self._record.trouble:
            deadlines.append(clocks.boot_time() + RECORD_AGAIN)
        starts = self._starts.values()
        deadlines += [start.due if self._is_late(start) else start.late for start in starts]
        due = [deadline for deadline in deadlines if deadline is not None]
        _guarded(self._set_timer, deadlines[0])
        return min(max(0.0, min(due) - clocks.boot_time()), LONGEST_WAIT) if due else None

    def _set_timer(self, deadline: float | None) -> None:
        """Set the timer by which the loop wakes at a deadline of the core, also after a suspend."""
        if self._timer is None and deadline is not None:
            timer = BootTimer()
            if timer.descriptor >= 0:
                try:
                    self._watch(timer.descriptor, timer.clear)
                except OSError:
                    os.close(timer.descriptor)
                    raise
            self._timer = timer  # only now: after a failure the next round tries again
        if self._timer is not None:
            self._timer.set(deadline)

    def _leave(self) -> None:
        self._groups.close()
        with contextlib.suppress(OSError):  # the next supervisor replaces a socket that stays
            self.disk.ask(partial(os.unlink, os.path.join(self._state, paths.SOCKET)))
        if self._client is not None:
            self._client.finish(messages.encode_ended(), END_PATIENCE)
        with contextlib.suppress(OSError):  # writes the last lines of the own log, too
            self.disk.ask(endpoint.release_lock)
        if self._late_disk() is not None:  # its thread delays the end of this process
            self._listener.close()
            if self._client is not None:
                self._client.close()

    # --- the core's commands ------------------------------------------------------------------

    def _happened(self, event: Event) -> None:
        for command in self._core.handle(event, clocks.boot_time()):
            _guarded(self._execute, command)  # the core counts on each of them

    def _execute(self, command: commands.Command) -> None:
        if isinstance(command, commands.ReportStatus):
            self._note_status(command.instance)
        elif isinstance(command, commands.Spawn):
            self._spawns.append(command.instance)
        elif isinstance(command, commands.Signal):
            self._trees.signal(command.instance, command.number)
        elif isinstance(command, commands.Unspawn):
            self._unspawn(command.instance)
        elif isinstance(command, commands.Drop):
            self._record.dead(command.instance, self._core.dead[command.instance[0]])
        else:
            self._leaving = True

    def _note_status(self, key: Key) -> None:
        instance = self._core.instances[key]
        if instance.ended:
            self._launches.pop(key, None)
        if not instance.pid and instance.phase != STOPPING:
            self._trees.release(key)
            if instance.ended:
                self._ended.append(key)
            elif instance.started or instance.phase == BACKOFF:  # else they may be made ahead
                self._groups.remove(key, clocks.boot_time())
        self._record.state(instance, self._trees.birth(key), self._groups.kills_before(key))
        status = messages.Status.of(instance, clocks.boot_time())
        # The slave has ordered the start, and most spawns take a moment. So `starting` is sent only
        # if the spawn cannot begin in this round, or is late.
        self._first_starts.pop(key, None)
        if instance.phase == STARTING and not instance.started:
            self._first_starts[key] = status
        else:
            self._unsent.append(messages.encode_status(status))
        if instance.ended:
            self._logs.release(key)

    def _unspawn(self, key: Key) -> None:
        begun = [start for start in self._starts.values() if start.key == key]
        # One that executes its program by now is stopped as any other.
        waiting = [start for start in begun if not start.attempt.read()]
        for start in waiting:
            self._abandon(start)
        if key in self._spawns:
            self._spawns.remove(key)
        elif not waiting:
            return
        self._happened(SpawnFailed(key, ""))

    def _report(self) -> None:
        prompt = {start.key for start in self._starts.values() if not self._is_late(start)}
        due = [self._first_starts.pop(key) for key in self._first_starts.keys() - prompt]
        unsent = b"".join([*self._unsent, *map(messages.encode_status, due)])
        self._unsent.clear()
        if self._client is not None and unsent:
            self._send(self._client, unsent)

    # --- spawning -----------------------------------------------------------------------------

    def _prepare_held(self) -> None:
        """Open the log and make the control groups of the next held instance before its start.

        A fault is ignored, because the start tries again.
        """
        key = self._core.next_held
        launch = self._launches.get(key) if key is not None else None
        if key is None or key == self._prepared or launch is None:
            return
        self._prepared = key
        self._logs.prepare(key)
        self._confinement.prepare(key, launch.limits)

    def _remove_groups(self) -> None:
        """Remove the control groups of ended instances, after held instances have been started.

        The removal takes time by which a held instance would otherwise start later.
        """
        for key in self._ended:
            self._groups.remove(key, clocks.boot_time())
        self._ended.clear()

    def _spawn_some(self) -> None:
        count = min(len(self._spawns), self._room_for_starts())
        if not count or self._waits_for_disk():
            return
        keys = [self._spawns.popleft() for _ in range(count)]
        self._record.spawning(keys)
        durable = self._record.flush()
        if not durable and self.disk.is_late:
            self._spawns.extendleft(reversed(keys))
            return
        delayed = []
        for key in keys:
            if not durable:
                failed = f"not started, because it could not be recorded: {self._record.trouble}"
                self._spawn_failed(key, failed, transient=True)
                continue
            try:
                self._spawn(key)
            except NoAnswer:
                delayed.append(key)
            except Exception as fault:  # noqa: BLE001 - the core counts on an outcome of each
                self._spawn_raised(key, fault)
        self._spawns.extendleft(reversed(delayed))

    def _late_disk(self) -> FileThread | None:
        """Return the thread of a directory that does not answer."""
        return next((disk for disk in (self.disk, self._logs.disk) if disk.is_late), None)

    def _waits_for_disk(self) -> bool:
        """Return True if a directory is late; fail the starts if it is so for long."""
        late = self._late_disk()
        if late is not None and late.waits() > spawn.PATIENCE:
            waiting = tuple(self._spawns)
            self._spawns.clear()
            failed = f"not started, because {late.directory} does not answer ({spawn.PATIENCE:g} s)"
            for key in waiting:
                self._spawn_failed(key, failed, transient=True)
        return late is not None

    def _spawn(self, key: Key) -> None:
        launch = self._launches.get(key)
        if launch is not None and launch.adoption and not self._core.instances[key].started:
            self._adopt(key, launch, launch.adoption)
            return
        if self._null < 0:
            self._null = _open_null()
        self._check_former_start(key)
        program = self._program(launch)
        start = _Start(key, program, self._open_log(key))
        watch = (self._selector, lambda: self._read_report(start))

        def begin(group: int, scheduler: spawn.Scheduler | None) -> spawn.Attempt:
            with score_of_children():
                return spawn.begin(
                    program, self._null, start.log, group=group, scheduler=scheduler, watch=watch
                )

        assert launch is not None
        start.steps = self._confinement.start(key, launch.limits, begin)
        self._advance(start, lambda: next(start.steps))

    def _room_for_starts(self) -> int:
        """Return how many starts may begin, as each has a copy of this process before its exec.

        A late one waits for a path, and makes room for others.
        """
        young = sum(not self._is_late(start) for start in self._starts.values())
        return max(0, SPAWNS_A_ROUND - young)

    @staticmethod
    def _is_late(start: _Start) -> bool:
        return clocks.boot_time() >= start.late

    def _check_former_start(self, key: Key) -> None:
        for process, step in self._stuck.values():
            if process == key[0]:
                message = f"an earlier start of it still waits for {step}, which does not answer"
                raise SpawnError(message, transient=True)

    def _advance(self, start: _Start, step: Callable[[], spawn.Attempt]) -> None:
        """Continue a start, to its next attempt or to its end."""
        birth = procfs.ticks_now()
        stamps = ""
        try:
            start.attempt = step()
        except StopIteration as done:
            stamps = self._started(start, done.value)
        except Exception as fault:  # noqa: BLE001 - the core counts on an outcome
            send(start.executes, signal.SIGKILL)
            self._spawn_raised(start.key, fault)
        else:
            start.birth = birth
            self._starts[start.attempt.pid] = start
            return
        self._logs.close(start.log, stamps)

    def _read_report(self, start: _Start, *, lives: bool = True) -> None:
        """Read a part of the report of a start, and continue the start at the end of the report.

        `lives` is False for a process that was reaped: its pid may be another process's by now.
        """
        if not start.attempt.read():
            return
        pid = start.attempt.pid
        self._stop_watching(start)
        try:
            start.attempt.check()
        except (SpawnError, OSError) as error:
            fault = error
            self._advance(start, lambda: start.steps.throw(fault))
        else:
            start.executes = pid if lives else 0
            self._advance(start, lambda: start.steps.send(pid))

    def _stop_watching(self, start: _Start) -> None:
        del self._starts[start.attempt.pid]
        start.attempt.close()

    def _abandon(self, start: _Start) -> None:
        """Kill a process before its exec. It may end much later, so nothing waits for that."""
        self._stop_watching(start)
        self._logs.close(start.log)
        self._stuck[start.attempt.pid] = (start.key[0], start.attempt.step)
        send(start.attempt.pid, signal.SIGKILL)

    def _abandon_late(self, now: float) -> None:
        """Report the starts that have waited too long for a path."""
        for start in [one for one in self._starts.values() if one.due <= now]:
            if start.attempt.read():
                continue  # this process was stopped, or the machine suspended: it is no longer late
            self._abandon(start)
            failed = f"{start.attempt.step} does not answer ({spawn.PATIENCE:g} s)"
            self._spawn_failed(start.key, failed, transient=True)

    def _reaped(self, pid: int) -> None:
        """Note the end of a child that is no leader yet, and may have executed its program."""
        self._stuck.pop(pid, None)
        if pid in self._starts:
            self._read_report(self._starts[pid], lives=False)

    def _started(self, start: _Start, confined: Confined) -> str:
        """Report a start whose process executes its program; return the trace for its log."""
        key, (pid, enforced, note) = start.key, confined
        self._trees.add_child(key, pid, start.birth)
        environment = start.program.environment
        stamps = ""
        if start_trace.VARIABLE in environment and not self._core.instances[key].started:
            traced = start_trace.stamped_in(environment, spawned=clocks.wall_time_ns())
            stamps = traced[start_trace.VARIABLE]
        self._logs.watch(key, clocks.boot_time(), pid)
        unfound = _unfound(start.attempt.unfound, self._launches[key].directory)
        note = note.replace(self._state, "STATE")
        self._happened(Spawned(key, pid, enforced, note, unfound=unfound))
        return stamps

    def _adopt(self, key: Key, launch: messages.Launch, rule: AdoptionRule) -> None:
        """Take over a process that runs, instead of the first start of an instance."""
        leader = adoption.check(rule, self._trees.owner_of)
        if not self._trees.take_over(key, leader):
            self._spawn_failed(key, adoption.ended(rule), transient=False)
            return
        self._logs.note_adoption(key, rule.pid)
        self._logs.watch(key, clocks.boot_time(), rule.pid)
        wanted = launch.limits.wanted
        note = f"adopted, so only its first restart applies {listed(wanted)}" if wanted else ""
        self._happened(Spawned(key, rule.pid, (), note, adopted=True))

    def _spawn_raised(self, key: Key, fault: Exception) -> None:
        """Report a start that an exception has ended."""
        if isinstance(fault, SpawnError):
            self._spawn_failed(key, str(fault), fault.transient)
        elif isinstance(fault, OSError):
            failed = f"it cannot be started now: {reason_of(fault)}"
            self._spawn_failed(key, failed, transient=True)
        else:
            own_log.write_fault(f"the start of {mark(key)} failed")
            failed = f"its start failed in the supervisor: {fault!r}"
            self._spawn_failed(key, failed, is_transient(fault))

    def _spawn_failed(self, key: Key, reason: str, transient: bool) -> None:
        """Report a failure. All clients may read the reason, so STATE stands for the directory."""
        self._happened(SpawnFailed(key, reason.replace(self._state, "STATE"), transient))

    def _open_log(self, key: Key) -> int:
        try:
            return self._logs.open(key)
        except NoAnswer:
            raise
        except OSError as error:
            message = f"its log cannot be opened: {reason_of(error)}"
            raise SpawnError(message, transient=True) from None

    def _program(self, launch: messages.Launch | None) -> spawn.Program:
        if launch is None:
            raise SpawnError("its order was lost with a part of the record")
        recorded = clocks.wall_time_ns()
        environment = start_trace.stamped_in(self._environment(launch), recorded=recorded)
        directory = launch.directory or paths.work_directory(self._state)
        return spawn.Program(
            launch.argv, environment, directory, launch.secrets, launch.limits.nice, self._files,
            launch.files, launch.directory is None, launch.contents,
        )  # fmt: skip

    def _environment(self, launch: messages.Launch) -> dict[str, str]:
        base = self._environments.get(launch.environment)
        if base is None:
            raise SpawnError(
                "its environment was lost with a damaged part of the record: it cannot be started "
                "again by this order, only by a new one"
            )
        environment = dict(base)
        for name, value in launch.changes.items():
            if value is None:
                environment.pop(name, None)
            else:
                environment[name] = value
        environment[INSTANCE_MARK] = mark(launch.instance)
        environment[SUPERVISOR_MARK] = self._state
        return environment

    # --- the record ---------------------------------------------------------------------------

    def _take_over(self) -> None:
        recorded = takeover.restore(self._state, self._core, self._trees)
        self._groups.find_again(
            {
                key: recorded.kills[key]
                for key, instance in self._core.instances.items()
                if not instance.ended
            }
        )
        self._launches.update(recorded.launches)
        self._environments.update(recorded.environments)
        self._notes = recorded.notes
        for note in recorded.notes:
            own_log.write(note)
        for event in takeover.what_happened(recorded, self._state, self._core, self._trees):
            self._happened(event)
        # the former supervisor may not have started a held instance
        self._happened(events.TimePassed())
        self._rewrite_record()
        for instance in self._core.instances.values():
            if instance.pid:
                self._logs.watch(instance.key, clocks.boot_time())

    def _rewrite_record(self) -> None:
        used = {launch.environment for launch in self._launches.values()}
        if self._client is not None:
            used.add(self._client.environment)  # sent once; later launches refer to it
        for identity in self._environments.keys() - used:
            del self._environments[identity]
        self._record.rewrite(
            self._core, self._launches, self._environments, self._trees.birth,
            self._groups.kills_before,
        )  # fmt: skip

    # --- the client ---------------------------------------------------------------------------

    def _accept(self) -> None:
        try:
            peer, _ = self._listener.accept()
        except OSError as error:
            if error.errno in (errno.EMFILE, errno.ENFILE):
                self._turn_away()
            return  # the peer is gone: it connects again
        connection = Connection(peer)
        self._watch(connection, lambda: self._readable(connection))
        if connection.uid not in (0, os.geteuid()):
            self._refuse(connection, "this supervisor belongs to another user")
            self._send(connection, b"")

    def _turn_away(self) -> None:
        """Accept and close a connection for which no descriptor is left.

        Otherwise the selector would report it in every round, without a wait.
        """
        spare, self._null = self._null, -1  # its number may soon be that of another file
        if spare >= 0:
            os.close(spare)  # for a moment, because a connection needs a descriptor
        with contextlib.suppress(OSError):
            self._listener.accept()[0].close()
        self._null = _open_null()

    def _readable(self, connection: Connection) -> None:
        try:
            for line in connection.read():
                if not connection.closing:
                    self._obey(connection, messages.decode_order(line))
        except ProtocolError as error:
            self._refuse(connection, str(error))
        except Exception as fault:  # noqa: BLE001 - no order may end the parent of all processes
            own_log.write_fault("an order failed, and its connection is closed")
            self._refuse(connection, f"the order failed in the supervisor: {fault!r}")
        self._send(connection, b"")

    def _obey(self, connection: Connection, order: messages.Order) -> None:
        if isinstance(order, messages.Hello):
            self._welcome(connection, order)
        elif connection is not self._client:
            raise ProtocolError("the first order must be hello")
        elif isinstance(order, messages.Environment):
            self._learn_environment(connection, order)
        elif isinstance(order, messages.Launch):
            self._start(order)
        elif isinstance(order, messages.Amend):
            self._amend(order)
        elif isinstance(order, messages.Remember):
            self._remember(order)
        elif isinstance(order, messages.Forget):
            for forgotten in order.instances:
                self._happened(forgotten)
        elif isinstance(order, events.ContactReported):
            self._renew(order)
        else:
            self._happened(order)

    def _welcome(self, connection: Connection, hello: messages.Hello) -> None:
        if connection is self._client:
            raise ProtocolError("hello was sent twice")
        if hello.protocol != messages.PROTOCOL:
            raise ProtocolError(
                f"this supervisor (pid {os.getpid()}) speaks protocol {messages.PROTOCOL}, "
                f"you speak {hello.protocol}"
            )
        if self._client is not None and not self._client_is_gone(self._client):
            raise ProtocolError(
                f"another slave (pid {self._client.pid}) is connected to the supervisor of "
                f"{self._state}; one host has one slave"
            )
        self._client = connection
        self._served = True
        self._logs.limit(hello.log)
        self._unsent.clear()  # the welcome's statuses hold all of these changes
        self._first_starts.clear()
        now = clocks.boot_time()
        statuses = [messages.Status.of(one, now) for one in self._core.instances.values()]
        memos = {key: launch.memo for key, launch in self._launches.items() if launch.memo}
        fenced = [one.key for one in self._core.instances.values() if one.fence is not None]
        self._record.flush()
        welcome = messages.encode_welcome(
            os.getpid(), self._notes, statuses, memos, fenced,
            unenforced=self._confinement.missing,
            groups=[(tree.version, tree.top, tree.controllers) for tree in self._groups.trees],
        )  # fmt: skip
        connection.send(welcome)

    def _client_is_gone(self, client: Connection) -> bool:
        """Return True if the client is gone, also if it left in this very round."""
        self._readable(client)
        return client.gone

    def _learn_environment(self, client: Connection, order: messages.Environment) -> None:
        client.environment = order.id
        if order.id not in self._environments:
            self._environments[order.id] = dict(order.variables)
            self._record.environment(order.id, order.variables)

    def _start(self, launch: messages.Launch) -> None:
        if launch.environment not in self._environments:
            raise ProtocolError(f"unknown environment {launch.environment!r}")
        received = start_trace.stamped_in(launch.changes, supervisor_received=clocks.wall_time_ns())
        if received is not launch.changes:
            launch = launch._replace(changes=received)
        if launch.instance not in self._core.instances:
            self._launches[launch.instance] = launch
            self._record.launch(launch)
        self._happened(
            events.StartOrdered(
                launch.instance, launch.restart, launch.stop, launch.fence,
                launch.heard or None, launch.slots,
            )
        )  # fmt: skip

    def _renew(self, order: events.ContactReported) -> None:
        now = clocks.boot_time()
        newest = events.ContactReported(min(order.at, now), min(order.alive, now))
        self._last_contact.keep(newest)
        self._happened(newest)

    def _amend(self, amendment: messages.Amend) -> None:
        launch, held, refusal = self._launches.get(amendment.instance), None, ""
        try:
            if launch is not None:
                held = self._change_limits(launch, amendment)
                self._keep_launch(launch.amended(amendment))
            self._happened(events.AmendOrdered(amendment.instance, amendment.restart, held))
        except LimitRefused as refused:
            refusal = str(refused).replace(self._state, "STATE")
        self._unsent.append(messages.encode_amended(amendment, refusal))

    def _change_limits(
        self, launch: messages.Launch, amendment: messages.Amend
    ) -> tuple[str, ...] | None:
        """Change the limits of a run; return those that hold, None: nothing runs, or they stay."""
        limits = launch.limits.with_limits(amendment.limits)
        runs = self._core.instances[launch.instance].pid
        if limits == launch.limits or not runs:
            return None
        return self._confinement.change(launch.instance, launch.limits, limits)

    def _remember(self, order: messages.Remember) -> None:
        launch = self._launches.get(order.instance)
        if launch is not None:  # an ended instance has no launch, so no memo to keep
            self._keep_launch(launch._replace(memo=order.memo))

    def _keep_launch(self, launch: messages.Launch) -> None:
        if launch != self._launches[launch.instance]:
            self._launches[launch.instance] = launch
            self._record.launch(launch)

    def _refuse(self, connection: Connection, message: str) -> None:
        connection.closing = True
        connection.send(messages.encode_refusal(message))

    def _send(self, connection: Connection, data: bytes) -> None:
        """Send, then either watch the peer for room to write, or drop it if it is gone."""
        if not connection.gone:
            connection.send(data)
        if connection.gone:
            self._part(connection)
            return
        writes = selectors.EVENT_WRITE if connection.has_unsent else 0
        watched = self._selector.get_key(connection)
        if watched.events != selectors.EVENT_READ | writes:
            self._selector.modify(connection, selectors.EVENT_READ | writes, watched.data)

    def _part(self, connection: Connection) -> None:
        if connection.fileno() < 0:
            return
        self._selector.unregister(connection)
        connection.close()
        if connection is self._client:
            self._client = None
            self._happened(events.ClientLost())

    # --- signals ------------------------------------------------------------------------------

    def _watch_signals(self) -> None:
        """Let SIGCHLD and SIGTERM wake the loop by a pipe; ignore SIGINT and SIGHUP."""
        signals, wakeup = os.pipe2(os.O_CLOEXEC | os.O_NONBLOCK)
        signal.set_wakeup_fd(wakeup, warn_on_full_buffer=False)
        for number in (signal.SIGCHLD, signal.SIGTERM):
            signal.signal(number, lambda *_: None)
        for number in (signal.SIGINT, signal.SIGHUP):
            signal.signal(number, signal.SIG_IGN)
        self._selector.register(signals, selectors.EVENT_READ, lambda: self._signalled(signals))
        self._trees.reap()

    def _signalled(self, signals: int) -> None:
        numbers = os.read(signals, 4096)
        if signal.SIGCHLD in numbers:
            _guarded(self._trees.reap)  # a failure must not lose a SIGTERM
        if signal.SIGTERM in numbers:
            self._happened(events.ShutdownOrdered())

    def _watch(self, file: socket.socket | Connection | int, call: Callable[[], None]) -> None:
        self._selector.register(file, selectors.EVENT_READ, call)


def _guarded(call: Callable[..., None], *args: object) -> None:
    """Call a part of the loop; log a failure that the part does not handle.

    Neither a full disk nor a bug in one part may end the parent of all processes. The pause bounds
    the work if the same failure follows at once.
    """
    try:
        call(*args)
    except Exception as fault:  # noqa: BLE001 - see above
        own_log.write_fault(f"a part of the loop failed: {fault}")
        time.sleep(PAUSE_AFTER_FAULT)


def _unfound(words: Sequence[str], directory: str | None) -> str:
    """Return a sentence on files that did not exist at a start; "": there are none.

    Args:
        directory: the `working_directory` of the process; None: that of the supervisor.
    """
    where = (
        "a directory of rosrm's own, because it has no `working_directory` (`.` is the folder of "
        "its file)"
        if directory is None
        else f"its `working_directory`, {directory!r}"
    )
    named = " and ".join(map(repr, words))
    return f"there was no {named} in {where}" if words else ""


def _open_null() -> int:
    return os.open(os.devnull, os.O_RDWR | os.O_CLOEXEC)
