"""Control groups of the instances: one for each, which limits, measures and kills its processes.

The path of a group follows from the instance, so the next supervisor finds it again. A process
enters its group by inheritance: in version 1 the supervisor itself is in the group while it spawns
(moving a process that runs would take 10 ms, because the kernel then waits for an RCU grace
period); in version 2 the kernel starts the process in it (`spawn_into.py`).

In version 1 a group of the controller cpu alone is made only for a limit of CPU time. To enter one
takes ten times as long as any other, because the scheduler queues the supervisor again.
"""

from __future__ import annotations

import contextlib
import errno
import os
import signal
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final

from rosrm.core.supervisor.rules import Key, LimitRule
from rosrm.runtime import cgroups
from rosrm.runtime.signalling import send
from rosrm.shortage import is_directory, raise_shortage
from rosrm.supervisor import own_log, procfs
from rosrm.supervisor.group_trees import PREFIX, Tree, make_repeatedly, make_top
from rosrm.supervisor.paths import safe_name
from rosrm.supervisor.spawn_error import is_transient
from rosrm.wording import counted, reason_of, size

#: Most walks over the processes of a group of version 1, which may fork.
_WALKS: Final = 20
#: Seconds between two attempts to remove a group that the kernel still counts as used.
_REMOVE_AGAIN: Final = 0.2
#: Seconds between two attempts of the supervisor to leave the group of an instance.
_RETURN_AGAIN: Final = 1.0
#: Links of a folder without folders in it.
_LINKS: Final = 2
#: Assumed number of OOM kills before a run if the count cannot be read. A group never has as many,
#: so no kill counts as one of this run.
_UNKNOWN: Final = 2**53
#: Bytes; a limit above this is none (version 1 writes 2**63 less a page).
_NO_LIMIT: Final = 2**62


class LimitRefused(Exception):
    """A limit of a running instance cannot be changed; its message says why."""


class InstanceGroups:
    """The control groups of one supervisor's instances.

    Attributes:
        trees: where they are made; (): no instance has a group.
    """

    def __init__(self, trees: Sequence[Tree] = ()) -> None:
        self.trees = tuple(trees)
        self._made: dict[Key, tuple[Tree, ...]] = {}
        self._unset: dict[Key, dict[str, Any]] = {}  # limits that could not be set at the start
        self._kills_before: dict[Key, int] = {}
        self._prepared: dict[Key, LimitRule] = {}  # limits of groups made ahead without a fault
        self._emptied: dict[str, float] = {}
        self._homes: dict[str, int] = {}  # group to descriptor of its `tasks` file, for the return
        self._left: dict[str, float] = {}  # groups to return to, with the time of the next attempt
        self._unfinished: dict[Key, set[Tree]] = {}  # groups that some processes did not enter

    def find_again(self, live: Mapping[Key, int]) -> None:
        """Find the groups of instances of an earlier supervisor; kill and remove all others.

        Groups of supervisors that have ended beside this one, and have no processes, are removed.

        Args:
            live: each instance that has not ended, with its `kills_before`.

        Raises:
            OSError: the group of one of them cannot be looked at now; nothing was killed.
        """
        for key, kills in live.items():
            found = tuple(tree for tree in self.trees if is_directory(_path(tree, key)))
            if found:
                self._made[key], self._kills_before[key] = found, kills
        known = set(map(group_name, live))
        for tree in self.trees:
            for name in _folders(tree.top) - known:
                self._end(os.path.join(tree.top, name), 0.0)
            base = os.path.dirname(tree.top)
            for other in _folders(base) - {os.path.basename(tree.top)}:
                if other.startswith(PREFIX):
                    remove_empty(os.path.join(base, other))

    def prepare(self, key: Key, limits: LimitRule, *, realtime: bool) -> None:
        """Make the group of an instance ahead of its start, for the next `make`.

        After a fault the next `make` tries again, because the fault may be over by then.
        """
        with contextlib.suppress(OSError):
            if not self.make(key, limits, realtime=realtime):
                self._prepared[key] = limits

    def make(self, key: Key, limits: LimitRule, *, realtime: bool) -> dict[str, str]:
        """Make the group of an instance with its limits; return the faults by limit.

        Args:
            realtime: leave out groups of the controller cpu of version 1, which by default allow
                no real-time scheduling, and whose limits have no effect on it.

        Raises:
            OSError: required limits cannot be set, by an error that may pass (`is_transient`).
        """
        if self._prepared.pop(key, None) == limits:
            return {}
        faults: dict[str, str] = {}
        self._made[key], is_new = (), True
        for tree in self.trees:
            if not self._needs(tree, limits, realtime=realtime):
                continue
            path = _path(tree, key)
            self._emptied.pop(path, None)  # otherwise the new run would be killed
            try:
                is_new = _make(path, tree) and is_new
                self._made[key] += (tree,)
                faults.update(_set_limits(path, tree, limits))
            except OSError as error:
                _raise_transient(error, limits)
                fault = f"no control group {path} can be made: {reason_of(error)}"
                faults.update(
                    (name, fault) for name, controller in _CONTROLLER.items()
                    if controller in tree.controllers
                )  # fmt: skip
        self._unset[key] = {name.removeprefix("limits."): 0.0 for name in faults}
        self._kills_before[key] = 0 if is_new else self._kills(key, _UNKNOWN)
        return faults

    def _needs(self, tree: Tree, limits: LimitRule, *, realtime: bool) -> bool:
        """Return True if an instance needs a group in a tree; the first one has its members."""
        if tree.version != 1 or "cpu" not in tree.controllers:
            return True
        only_limits = tree.controllers == ("cpu",) and tree != self.trees[0]
        return not realtime and bool(limits.cpu or not only_limits)

    def add(self, key: Key, limits: LimitRule) -> None:
        """Make the groups that a running instance lacks for new limits; move its processes there.

        `lacking` returns each limit whose group is missing or does not contain all processes.
        """
        made = self._made.get(key, ())
        for tree in self.trees:
            needs = self._needs(tree, limits, realtime=bool(limits.policy))
            if made and tree not in made and needs:
                path = _path(tree, key)
                self._emptied.pop(path, None)  # otherwise the moved processes would be killed
                try:
                    _make(path, tree)
                    _move_all(_path(made[0], key), path)
                except OSError as error:
                    own_log.write(f"the control group {path} cannot be used: {reason_of(error)}")
                    self._undo(key, tree)
                else:
                    self._made[key] = (*self._made[key], tree)

    def _undo(self, key: Key, tree: Tree) -> None:
        """Move processes back out of a group that not all could enter, and remove the group."""
        path = _path(tree, key)
        with contextlib.suppress(OSError):  # the group stays, and is removed with the instance
            for pid in pids(path):
                with contextlib.suppress(OSError):
                    cgroups.write(os.path.join(tree.home, "cgroup.procs"), str(pid))
        remove_empty(path)
        # A process may have forked during the loop.
        self._unfinished.setdefault(key, set()).add(tree)

    def lacking(self, key: Key, limits: LimitRule) -> dict[str, str]:
        """Return the limits for which an instance has no group, with the reasons."""
        known = {name for tree in self._made.get(key, ()) for name in tree.controllers}
        why = "the instance has no control group for it"
        return {name: why for name in limits.given_limits if _CONTROLLER[name] not in known}

    def change(self, key: Key, former: LimitRule, limits: LimitRule) -> None:
        """Change the limits of an instance that runs, in the groups that it has.

        Raises:
            LimitRefused: one of them cannot be changed; all are as before.
        """
        unset = self._unset.pop(key, {})
        former = former._replace(**unset)
        trees, done = self._made.get(key, ()), list[Tree]()
        for tree in trees:
            path = _path(tree, key)
            done.append(tree)
            fault = _above(path, tree, limits) if limits.memory != former.memory else ""
            faults = [fault] if fault else _set_limits(path, tree, limits, former).values()
            for fault in faults:
                for changed in done:
                    _set_limits(_path(changed, key), changed, former, limits)
                self._unset[key] = unset
                raise LimitRefused(fault)

    @contextlib.contextmanager
    def inside(self, key: Key) -> Iterator[int]:
        """Spawn an instance in this context: in its group, if it has one.

        Yields a descriptor of the group of version 2; -1: it has none. Raises OSError if the group
        is gone.
        """
        trees = self._made.get(key, ())
        with contextlib.ExitStack() as left:
            group = -1
            for tree in trees:
                path = _path(tree, key)
                if tree.version == 2:
                    group = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
                    left.callback(os.close, group)
                else:
                    # A thread that moves itself alone needs no grace period; this is the only one.
                    self._open_home(tree.home)  # before the group is entered: this may fail
                    left.callback(self._return, tree.home)
                    _enter(path)
            yield group

    def _open_home(self, home: str) -> None:
        if home not in self._homes:
            tasks = os.path.join(home, "tasks")
            self._homes[home] = os.open(tasks, os.O_WRONLY | os.O_CLOEXEC)

    def _return(self, home: str) -> None:
        """Move this thread back to its own group; after a failure `look` tries again."""
        try:
            os.write(self._homes[home], b"0")
            self._left.pop(home, None)
        except OSError as error:
            os.close(self._homes.pop(home))  # the group may have been made again
            self._left.setdefault(home, 0.0)
            own_log.write(f"the control group {home} cannot be entered again: {reason_of(error)}")

    def _return_again(self, now: float) -> None:
        for home, due in list(self._left.items()):
            if due <= now:
                self._left[home] = now + _RETURN_AGAIN
                self._open_home(home)
                self._return(home)

    def members(self, key: Key) -> list[int] | None:
        """Return the pids of all processes of an instance; None: it has no group.

        Raises:
            OSError: the system has no room for a look.
        """
        trees = self._made.get(key)
        if not trees:
            return None
        return pids(_path(trees[0], key))

    def kill(self, key: Key) -> bool:
        """Send SIGKILL to all processes of an instance; return False if it has no group."""
        trees = self._made.get(key)
        if not trees:
            return False
        kill(_path(trees[0], key))
        return True

    def kills_before(self, key: Key) -> int:
        """Return the number of OOM kills in the group of an instance before its run."""
        return self._kills_before.get(key, 0)

    def out_of_memory(self, key: Key) -> tuple[float, float] | None:
        """Return used bytes and limit (0: none) if the OOM killer ended a process of this run.

        None: it did not, or the count cannot be read.
        """
        if self._kills(key, 0) <= self.kills_before(key):
            return None
        tree = self._memory_tree(key)
        assert tree is not None
        path = _path(tree, key)
        used, limit = _PEAK[tree.version], _MEMORY[tree.version]
        most = _number(os.path.join(path, limit))
        return _number(os.path.join(path, used)) or most, most

    def remove(self, key: Key, now: float) -> None:
        """Remove the group of an instance that has ended, with all that may be left in it."""
        self._prepared.pop(key, None)
        self._kills_before.pop(key, None)
        self._unset.pop(key, None)
        for tree in (*self._made.pop(key, ()), *self._unfinished.pop(key, ())):
            self._end(_path(tree, key), now)

    def look(self, now: float) -> None:
        """Leave and remove groups for which that failed before; called in each round.

        Raises:
            OSError: the supervisor's own group cannot be opened now; a later call tries again.
        """
        for path, due in list(self._emptied.items()):
            if due <= now:
                del self._emptied[path]
                self._end(path, now)
        self._return_again(now)

    def deadline(self) -> float | None:
        """Return the time at which `look` is due; None: it has nothing to do."""
        return min((*self._emptied.values(), *self._left.values()), default=None)

    def close(self) -> None:
        """Remove the groups of all instances if no process is left."""
        for tree in self.trees:
            remove_empty(tree.top)

    def _end(self, path: str, now: float) -> None:
        try:
            os.rmdir(path)
        except FileNotFoundError:
            return
        except OSError:  # a process is there, or the kernel has not released the last one yet
            kill(path)
            remove_empty(path)
            self._emptied[path] = now + _REMOVE_AGAIN

    def _memory_tree(self, key: Key) -> Tree | None:
        return next((t for t in self._made.get(key, ()) if "memory" in t.controllers), None)

    def _kills(self, key: Key, unknown: int) -> int:
        """Return the number of OOM kills in the group of an instance, or `unknown`."""
        tree = self._memory_tree(key)
        if tree is None:
            return 0
        name = "memory.oom_control" if tree.version == 1 else "memory.events"
        try:
            return _counts(os.path.join(_path(tree, key), name)).get("oom_kill", 0)
        except OSError:
            return unknown


def remove_empty(group: str) -> None:
    """Remove a group and those below it, as far as no process is in them."""
    for name in _folders(group):
        remove_empty(os.path.join(group, name))
    with contextlib.suppress(OSError):
        os.rmdir(group)


def pids(group: str) -> list[int]:
    """Return the other processes in a group and those below it; [] if it is gone.

    Raises:
        OSError: the system has no room for a look, so the group may have processes.
    """
    try:
        listed = map(int, procfs.content(os.path.join(group, "cgroup.procs")).split())
        # 0: a process outside of our pid namespace; a signal to 0 would reach ourselves.
        found = [pid for pid in listed if pid not in (0, os.getpid())]
        # More links: a process of the instance has made groups.
        below = _folders_in(group) if os.stat(group).st_nlink > _LINKS else ()
    except OSError as error:
        raise_shortage(error)
        return []
    for name in below:
        found += pids(os.path.join(group, name))
    return found


def kill(path: str) -> None:
    """Send SIGKILL to all processes of a group, including those forked during the call."""
    try:
        cgroups.write(os.path.join(path, "cgroup.kill"), "1")
    except OSError:  # version 1, or a kernel before 5.14
        for _ in range(_WALKS):
            try:
                left = pids(path)
            except OSError:  # the caller kills what it knows, and looks again
                return
            for pid in left:
                send(pid, signal.SIGKILL)
            if not left:
                return


# --- files of a group -------------------------------------------------------------------------

#: Controller of each limit.
_CONTROLLER: Final = {
    "limits.memory": "memory", "limits.memory_high": "memory", "limits.cpu": "cpu",
}  # fmt: skip
_MEMORY: Final = {1: "memory.limit_in_bytes", 2: "memory.max"}
_PEAK: Final = {1: "memory.max_usage_in_bytes", 2: "memory.peak"}
_UNLIMITED: Final = LimitRule()


def limit_files(
    version: int, limits: LimitRule, former: LimitRule = _UNLIMITED
) -> Iterator[tuple[str, str, str]]:
    """Yield name of the limit, control file and content, in the order of writing.

    Args:
        former: the limits of the group; those that stay are left out.
    """
    if limits.memory != former.memory:
        files = cgroups.memory_files(version, int(limits.memory))
        # Version 1 refuses a limit of memory above that of memory and swap.
        raised = former.memory and not 0 < limits.memory < former.memory
        for file, content in reversed(files) if raised else files:
            yield "limits.memory", file, content
        if version == 2:  # the instance ends as a whole, and is reported
            yield "limits.memory", "memory.oom.group", str(int(limits.memory > 0))
    if limits.memory_high != former.memory_high and version == 2:
        high = str(int(limits.memory_high)) if limits.memory_high else "max"
        yield "limits.memory_high", "memory.high", high
    if limits.cpu != former.cpu:
        # Version 1 checks period and quota one after the other, against the group above.
        files = cgroups.cpu_files(version, 0.0) if former.cpu and version == 1 else []
        for file, content in (*files, *cgroups.cpu_files(version, limits.cpu)):
            yield "limits.cpu", file, content


def _set_limits(
    path: str, tree: Tree, limits: LimitRule, former: LimitRule = _UNLIMITED
) -> dict[str, str]:
    faults: dict[str, str] = {}
    for name, file, content in limit_files(tree.version, limits, former):
        if _CONTROLLER[name] not in tree.controllers:
            continue
        try:
            cgroups.write(os.path.join(path, file), content)
        except OSError as error:
            if error.errno == errno.ENOENT and file in cgroups.ABOUT_SWAP:
                continue
            # Version 1 refuses a share above that of a group above, which then is the limit.
            if error.errno == errno.EINVAL and file == "cpu.cfs_quota_us":
                continue
            if former is _UNLIMITED:
                _raise_transient(error, limits)
            faults.setdefault(name, _why(path, file, error, limits))
    return faults


def _raise_transient(error: OSError, limits: LimitRule) -> None:
    """Raise an error that may pass, where the limits are required.

    Otherwise this host would count as one that cannot enforce them.
    """
    if limits.required and is_transient(error):
        raise error


def _why(path: str, file: str, error: OSError, limits: LimitRule) -> str:
    if error.errno == errno.EBUSY:  # of a former run, if the kernel has not given it back
        return _uses(_number(os.path.join(path, "memory.usage_in_bytes")), limits)
    return f"{file} of the control group {path} cannot be written: {reason_of(error)}"


def _uses(used: float, limits: LimitRule) -> str:
    return f"its control group uses {size(used)} already, and the limit is {size(limits.memory)}"


def _above(path: str, tree: Tree, limits: LimitRule) -> str:
    """Return why a limit of memory is below the usage of a group of version 2; "": it is not.

    Version 1 refuses such a limit. Version 2 accepts it, and kills processes of the group.
    """
    if not limits.memory or tree.version == 1 or "memory" not in tree.controllers:
        return ""
    try:
        used = float(cgroups.read(os.path.join(path, "memory.current")))
        pages = _counts(os.path.join(path, "memory.stat")) if used > limits.memory else {}
    except OSError as error:
        return f"the usage of the control group {path} cannot be read: {reason_of(error)}"
    if used > limits.memory:
        used -= sum(pages.get(name, 0) for name in ("active_file", "inactive_file"))
    return _uses(used, limits) if used > limits.memory else ""


def _make(path: str, tree: Tree) -> bool:
    """Make a group; return False if it is that of a former run, with its counters."""
    try:
        os.mkdir(path)
    except FileExistsError:
        try:
            os.rmdir(path)
            os.mkdir(path)
        except OSError:
            return False
    except FileNotFoundError:  # the first one, or another supervisor removed the group above

        def make_both() -> None:
            make_top(tree)
            os.mkdir(path)

        make_repeatedly(make_both)
    return True


def _move_all(source: str, target: str) -> None:
    """Move the processes of a group of version 1 to another hierarchy, with those that they fork.

    Raises:
        OSError: a process cannot be moved, or they fork faster than they are moved.
    """
    for _ in range(_WALKS):
        left = set(pids(source)).difference(pids(target))
        for pid in left:
            with contextlib.suppress(ProcessLookupError):  # it has ended
                cgroups.write(os.path.join(target, "cgroup.procs"), str(pid))
        if not left:
            return
    raise OSError(errno.EAGAIN, f"{counted(len(left), 'process', 'processes')} outside of it")


def _enter(path: str) -> None:
    """Move this thread into a group of version 1. Raises OSError."""
    cgroups.write(os.path.join(path, "tasks"), "0")


def _number(path: str) -> float:
    """Return the number in a control file, for a message; 0: it cannot be read, or no limit."""
    try:
        text = cgroups.read(path).strip()
    except OSError:
        return 0.0
    return float(text) if text.isdigit() and int(text) < _NO_LIMIT else 0.0


def _counts(path: str) -> dict[str, int]:
    """Return the counts in a control file by name. Raises OSError."""
    lines = cgroups.read(path).splitlines()
    return {name: int(count) for name, count in map(str.split, lines)}


def _folders(path: str) -> set[str]:
    try:
        return _folders_in(path)
    except OSError:
        return set()


def _folders_in(path: str) -> set[str]:
    with os.scandir(path) as entries:
        return {entry.name for entry in entries if entry.is_dir(follow_symlinks=False)}


def group_name(key: Key) -> str:
    """Return the name of the group of an instance."""
    return f"{safe_name(key[0])}.{key[1]}"


def _path(tree: Tree, key: Key) -> str:
    return os.path.join(tree.top, group_name(key))
