"""Process trees of all instances while the supervisor runs: parenthood, adoption, reaping.

The supervisor is a subreaper: a process whose parent ends becomes its child. So the last process of
an instance always dies as the supervisor's child, and SIGCHLD reports it. An exception follows a
take-over (an earlier supervisor was killed): the processes are not children of the new supervisor,
which detects their end by a pidfd, or by looking at /proc once a second if none can be had.
"""

from __future__ import annotations

import contextlib
import os
import resource
import selectors
import signal
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from typing import Final

from rosrm.core.supervisor.events import Event, Exited, SessionEnded
from rosrm.core.supervisor.instance import UNKNOWN_EXIT
from rosrm.core.supervisor.rules import Key
from rosrm.runtime.signalling import send, send_by, send_to_group
from rosrm.supervisor import descriptors, own_log, procfs
from rosrm.supervisor.instance_groups import InstanceGroups
from rosrm.supervisor.procfs import Stat
from rosrm.wording import signal_name

#: In place of a pidfd: none can be had, and `look` finds the end of the process.
_NO_PIDFD: Final = -1
#: A child that has ended: pid, exit status and usage.
Waited = tuple[int, int, resource.struct_rusage]
#: Seconds between two looks at such processes.
_LOOK_EVERY: Final = 1.0


class ProcessTrees:
    """The living processes of all instances.

    Args:
        state: the state directory, which is also the supervisor's mark in environments.
        selector: watches the pidfds; the data of each is a function to call.
        happened: receives an event for each change of an instance.
        groups: control groups of the instances, which have all their processes.
        reaped: called with the pid of an ended child that is not known as a leader; it may add it.
        starting: children that are no leaders yet, although they may execute their programs, each
            with its instance.
    """

    def __init__(
        self, state: str, selector: selectors.BaseSelector, happened: Callable[[Event], None],
        groups: InstanceGroups, reaped: Callable[[int], None],
        starting: Callable[[], Mapping[int, Key]] = dict,
    ) -> None:  # fmt: skip
        self._groups = groups
        self._reaped = reaped
        self._starting = starting
        self._state = state
        self._selector = selector
        self._happened = happened
        self._sessions: dict[Key, int] = {}
        self._owners: dict[int, Key] = {}
        self._births: dict[Key, int] = {}
        self._children: dict[int, Key] = {}
        self._taken_over: dict[int, int] = {}
        self._in_foreign_session: set[Key] = set()
        self._looked_at: dict[int, tuple[int, Callable[[], None]]] = {}  # pid: its start, the call
        self._next_look = 0.0
        self._most_watched = descriptors.most_watched()
        self._adopted: dict[int, Key | None] = {}
        self._strays: dict[Key, dict[int, int]] = {}
        self._waited: deque[Waited] = deque()  # ended children with unhandled exit statuses
        self._ends: deque[tuple[int, Exited]] = deque()  # of leaders, not reported yet

    # --- session leaders --------------------------------------------------------------------------

    def add_child(self, key: Key, pid: int, birth: int) -> None:
        """Add a session leader spawned here at `birth` (clock ticks) or slightly later."""
        self._children[pid] = key
        self._add(key, pid, birth)

    def take_over(self, key: Key, leader: Stat) -> bool:
        """Add a leader that this supervisor did not spawn; return False if it has ended.

        An earlier supervisor spawned it, or it is adopted.

        Raises:
            OSError: the system has no room for a look.
        """
        try:
            pidfd = procfs.open_pidfd(leader.pid) if self._has_room() else _NO_PIDFD
        except ProcessLookupError:
            return False
        is_same = False
        try:
            now = procfs.read_stat(leader.pid)
            is_same = now is not None and procfs.was_born(now, leader.start)
        finally:
            if not is_same and pidfd != _NO_PIDFD:
                os.close(pidfd)
        if not is_same:
            return False  # it ended, and its pid was given to another process
        self._taken_over[leader.pid] = self._watch(
            pidfd, leader, lambda: self._taken_over_ended(key, leader.pid)
        )
        self._add(key, leader.pid, leader.start)
        if leader.session != leader.pid:  # it is adopted
            self._in_foreign_session.add(key)
        return True

    def look(self, now: float) -> None:
        """Find the ends of the processes that have no descriptor; called in each round.

        Do also what an error of the system has prevented before.

        Raises:
            OSError: the system has no room for a look; a later one continues.
        """
        self._handle_waited()
        for key in [key for key, watched in self._strays.items() if not watched]:
            self._look_for_strays(key)
        if now < self._next_look or not self._looked_at:
            return
        self._next_look = now + _LOOK_EVERY
        for pid, (birth, ended) in list(self._looked_at.items()):
            stat = procfs.read_stat(pid)
            if stat is None or not stat.alive or stat.start != birth:
                del self._looked_at[pid]
                ended()

    def deadline(self) -> float | None:
        """Return the time at which `look` has work; None: never."""
        if self._waited or self._ends or not all(self._strays.values()):
            return 0.0
        return self._next_look if self._looked_at else None

    def owner_of(self, pid: int) -> Key | None:
        """Return the instance whose leader is a process or one of its ancestors; None: of none."""
        while pid > 1 and pid not in self._owners:
            stat = procfs.read_stat(pid)
            pid = 0 if stat is None else stat.parent
        return self._owners.get(pid)

    def birth(self, key: Key) -> int:
        """Return the start time of the instance's leader in clock ticks; 0: not known."""
        return self._births.get(key, 0)

    def release(self, key: Key) -> None:
        """Remove the leader of an instance that has ended or starts again."""
        session = self._sessions.pop(key, 0)
        self._owners.pop(session, None)
        self._births.pop(key, None)
        self._in_foreign_session.discard(key)

    def _add(self, key: Key, pid: int, birth: int) -> None:
        self.release(key)
        self._sessions[key] = pid
        self._owners[pid] = key
        self._births[key] = birth

    def _taken_over_ended(self, key: Key, pid: int) -> None:
        self._unwatch(self._taken_over.pop(pid))
        memory = self._groups.out_of_memory(key)
        self._ends.append((pid, Exited(key, UNKNOWN_EXIT, leftovers=True, out_of_memory=memory)))
        self._report_ends()

    # --- reaping ------------------------------------------------------------------------------

    def reap(self) -> None:
        """Take the exit status of every child that has ended, and report the ends of leaders."""
        with contextlib.suppress(ChildProcessError):
            while (waited := os.wait4(-1, os.WNOHANG))[0]:
                self._waited.append(waited)
        self._handle_waited()

    def _handle_waited(self) -> None:
        """Report the ends of leaders; after a failure `look` continues and loses no exit code."""
        while self._waited:
            pid, status, usage = self._waited[0]
            self._adopted.pop(pid, None)
            if pid not in self._children:
                self._reaped(pid)
            self._waited.popleft()
            key = self._children.pop(pid, None)
            if key is not None:
                code = os.waitstatus_to_exitcode(status)
                exited = Exited(
                    key,
                    max(code, 0),
                    max(-code, 0),
                    usage.ru_maxrss * 1024.0,
                    usage.ru_utime + usage.ru_stime,
                    self._has_others(key, pid),
                    self._groups.out_of_memory(key) if code else None,
                )
                self._ends.append((pid, exited))
        self._report_ends()

    def _report_ends(self) -> None:
        """Report the ends of leaders, with what they left.

        No exit code may be lost: an end is removed only once all about it is known.

        Raises:
            OSError: the system has no room for a look at the other processes; `look` tries again.
        """
        if not self._ends:
            return
        self._look_at_adopted()
        owners = set(self._adopted.values())
        while self._ends:
            pid, exited = self._ends[0]
            key = exited.instance
            if exited.leftovers or key in owners:
                self.watch_strays(key, self._left(key, pid))
                exited = exited._replace(leftovers=key in self._strays)
            self._ends.popleft()
            self._happened(exited)

    def _has_others(self, key: Key, leader: int) -> bool:
        """Return True if an instance whose leader was just reaped may have other processes."""
        try:
            members = self._groups.members(key)
        except OSError:  # the exit code may not be lost; `_report_ends` looks again
            return True
        # Checked at once: the pid is not reused until its process group is empty.
        return procfs.group_is_alive(leader) if members is None else bool(members)

    def _left(self, key: Key, leader: int) -> list[Stat]:
        """Return the living processes of an instance whose leader has ended."""
        if key in self._in_foreign_session:
            return _below(leader)
        found = self.in_group(key)
        return procfs.find_members(leader, mark(key), self._state) if found is None else found

    def in_group(self, key: Key) -> list[Stat] | None:
        """Return the living processes in the group of an instance; None: it has no group.

        Raises:
            OSError: the system has no room for a look.
        """
        members = self._groups.members(key)
        if members is None:
            return None
        stats = map(procfs.read_stat, members)
        return [stat for stat in stats if stat is not None and stat.alive]

    def out_of_memory(self, key: Key) -> tuple[float, float] | None:
        """Return used bytes and limit (0: none) if the OOM killer ended a process of this run."""
        return self._groups.out_of_memory(key)

    def _look_at_adopted(self) -> None:
        """Find the instance of each adopted child; kill it if that has no leader."""
        starting = self._starting()
        begun = set(starting.values())
        for pid in procfs.own_children():
            if not any(pid in known for known in (self._children, self._adopted, starting)):
                key = self._owner(pid)
                if key in begun and key not in self._sessions:
                    continue  # its leader may execute its program already: a later look decides
                self._adopted[pid] = key
                if key is not None and key not in self._sessions:
                    own_log.write(f"killed {pid}, left over by {mark(key)}")
                    _note(send(pid, signal.SIGKILL), signal.SIGKILL, str(pid))

    def _owner(self, pid: int) -> Key | None:
        stat = procfs.read_stat(pid)
        if stat is None or not stat.alive:
            return None
        if stat.session in self._owners:
            return self._owners[stat.session]
        instance, supervisor = procfs.read_marks(pid)
        process, _, number = instance.rpartition("#")
        return (process, int(number)) if supervisor == self._state and number.isdigit() else None

    # --- strays: processes of an instance whose leader has ended ----------------------------------

    def watch_strays(self, key: Key, found: Iterable[Stat]) -> None:
        """Watch these processes; report `SessionEnded` when they and their forks have ended."""
        watched = self._strays.setdefault(key, {})
        for stat in found:
            # Beyond the limit they are found again when a watched one ends.
            if stat.pid not in watched and (self._has_room() or not watched):
                self._watch_stray(key, stat, watched)
        if not watched:
            del self._strays[key]

    def _watch_stray(self, key: Key, stat: Stat, watched: dict[int, int]) -> None:
        pid = stat.pid
        try:
            pidfd = procfs.open_pidfd(pid)
        except ProcessLookupError:
            return
        watched[pid] = self._watch(pidfd, stat, lambda: self._stray_ended(key, pid))

    def _stray_ended(self, key: Key, pid: int) -> None:
        watched = self._strays[key]
        self._unwatch(watched.pop(pid))
        if not watched:
            self._look_for_strays(key)

    def _look_for_strays(self, key: Key) -> None:
        """Look for further strays after the end of all that were watched. Raises OSError."""
        self.watch_strays(key, self._find(key))
        if key not in self._strays:
            self._happened(SessionEnded(key))

    def _find(self, key: Key) -> list[Stat]:
        session = self._sessions.get(key)
        if session is None and self._groups.members(key) is None:
            # The leader ended before this supervisor started.
            return procfs.find_marked(self._state).get(mark(key), [])
        return self._left(key, session or 0)

    # --- signals ------------------------------------------------------------------------------

    def signal(self, key: Key, number: int) -> None:
        """Send a signal to every process of the instance."""
        if number == signal.SIGKILL:
            self._groups.kill(key)  # also processes that left session and process group
        session = self._sessions.get(key, 0)
        if session in self._children or session in self._taken_over:
            self._signal_leader(key, session, number)
        if key in self._strays:
            try:
                self.watch_strays(key, self._find(key))
            finally:  # without room for a look the known ones get it all the same
                for pid, pidfd in self._strays.get(key, {}).items():
                    _send_to(pid, pidfd, number)

    def _signal_leader(self, key: Key, leader: int, number: int) -> None:
        """Send a signal to the process group of a leader.

        The group of an adopted process may have others, such as the script that started it. So the
        signal goes to the process alone, and its descendants are watched as strays. Its parent may
        have reaped it, and its pid may be that of another process.
        """
        if key not in self._in_foreign_session:
            _note(send_to_group(leader, number), number, f"the group {leader}")
            return
        try:
            self.watch_strays(key, _below(leader))
        finally:
            _send_to(leader, self._taken_over[leader], number)

    def kill(self, found: Iterable[Stat]) -> None:
        """Send SIGKILL to processes that belong to no instance any more."""
        for stat in found:
            _note(send(stat.pid, signal.SIGKILL), signal.SIGKILL, str(stat.pid))

    # --- the selector -------------------------------------------------------------------------

    def _has_room(self) -> bool:
        """Return True if another process may be watched by a descriptor."""
        return len(self._selector.get_map()) < self._most_watched

    def _watch(self, pidfd: int, stat: Stat, ended: Callable[[], None]) -> int:
        """Watch a process; return its pidfd, or `_NO_PIDFD` if it is looked at instead."""
        if pidfd != _NO_PIDFD:
            try:
                self._selector.register(pidfd, selectors.EVENT_READ, ended)
            except OSError as error:  # such as the bound on all selectors of this user
                own_log.write(f"{stat.pid} is looked at once a second: {error}")
                os.close(pidfd)
            else:
                return pidfd
        self._looked_at[stat.pid] = (stat.start, ended)
        return _NO_PIDFD

    def _unwatch(self, pidfd: int) -> None:
        if pidfd != _NO_PIDFD:
            self._selector.unregister(pidfd)
            os.close(pidfd)


def _below(pid: int) -> list[Stat]:
    """Return the living descendants of a process."""
    found = map(procfs.read_stat, procfs.descendants(pid))
    return [stat for stat in found if stat is not None and stat.alive]


def mark(key: Key) -> str:
    """Return the value by which the environment of its processes names an instance."""
    return f"{key[0]}#{key[1]}"


def _send_to(pid: int, pidfd: int, number: int) -> None:
    why = send(pid, number) if pidfd == _NO_PIDFD else send_by(pidfd, number)
    _note(why, number, str(pid))


def _note(why: str, number: int, what: str) -> None:
    """Log why a signal was refused."""
    if why:
        own_log.write(f"{signal_name(number)} to {what}: {why}")
