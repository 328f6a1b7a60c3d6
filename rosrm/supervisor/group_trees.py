"""Places where the supervisor may make control groups, and the limits that it can enforce.

Version 2 needs a delegated group; version 1 needs the right to make groups below the own one, once
for each hierarchy. The groups of a supervisor are in one group whose name has device and inode of
its state directory, because other supervisors may run in the same group.
"""

from __future__ import annotations

import contextlib
import errno
import os
import resource
from collections.abc import Callable
from typing import Final, NamedTuple

from rosrm.runtime import cgroups
from rosrm.shortage import is_directory
from rosrm.wording import reason_of

#: Prefix of the group that contains the groups of one supervisor.
PREFIX: Final = "rosrm-state-"
#: Controllers in order: the first tree answers questions about the members of a group.
_CONTROLLERS: Final = ("memory", "cpuacct", "cpu")
_TRIES: Final = 10
_CAP_SYS_NICE: Final = 1 << 23
_HOW: Final = (
    "start the slave by the unit that `rosrm service install slave` writes, or "
    "by `systemd-run --user --scope -p Delegate=yes rosrm slave`"
)


class Tree(NamedTuple):
    """A hierarchy in which the supervisor makes groups.

    Attributes:
        version: 1 or 2.
        top: directory of the groups of this supervisor.
        home: directory of the supervisor's own group.
        controllers: those that limit or measure something.
    """

    version: int
    top: str
    home: str
    controllers: tuple[str, ...]


class Enforcement(NamedTuple):
    """Limits that a supervisor can enforce.

    Attributes:
        trees: where it makes groups.
        missing: name of a limit or scheduling setting to the reason why it cannot be enforced.
    """

    trees: tuple[Tree, ...]
    missing: dict[str, str]


def find(state: str, root: str = "/") -> Enforcement:
    """Return where a supervisor may make groups; it makes its own one with the first of these.

    Args:
        state: the state directory.
        root: of the file system; another one for recorded trees.
    """
    trees: list[Tree] = []
    faults: dict[str, str] = {}
    try:
        found = cgroups.mounts(root)
    except OSError as error:
        unread = f"/proc/self/mountinfo cannot be read: {reason_of(error)}"
        found, faults = [], dict.fromkeys(cgroups.LIMITING, unread)
    for mount in found:
        known = {name for tree in trees for name in tree.controllers}
        try:
            tree = _tree(mount, known, _name(state), root)
        except OSError as error:
            faults.update(dict.fromkeys(_offered(mount) - known, _why_not(mount, error, root)))
            continue
        if tree is not None:
            trees.append(tree)
            for name in _offered(mount) - known - set(tree.controllers):
                held = f"the controller {name} is not delegated to {os.path.dirname(tree.top)}"
                faults[name] = f"{held}. To get it, {_HOW}"
    trees.sort(key=lambda tree: _CONTROLLERS.index(tree.controllers[0]))
    return Enforcement(tuple(trees), {**_missing(trees, faults), **_missing_rights()})


def _name(state: str) -> str:
    where = os.stat(state)
    return f"{PREFIX}{where.st_dev:x}-{where.st_ino:x}"


def _tree(mount: cgroups.Mount, known: set[str], name: str, root: str) -> Tree | None:
    """Return the tree at a mount; None: it has no controller that is of use here."""
    useful = _offered(mount) - known
    if not useful:
        return None
    home = cgroups.own_group(mount, root)
    if home is None:
        raise FileNotFoundError(errno.ENOENT, "the group of the supervisor is not visible")
    base = home
    if mount.version == 2:
        base = os.path.dirname(home) if os.path.basename(home) == cgroups.AGENTS else home
        given = set(cgroups.read(os.path.join(base, "cgroup.subtree_control")).split())
        useful &= given
        if not useful:
            raise OSError(errno.EBUSY, "it gives no controllers to groups below it")
    controllers = tuple(one for one in _CONTROLLERS if one in useful)
    top = os.path.join(base, name)
    tree = Tree(mount.version, top, home, controllers)
    if not is_directory(top):
        try:
            make_repeatedly(lambda: make_top(tree))
        finally:
            with contextlib.suppress(OSError):
                os.rmdir(top)
    return tree


def make_top(tree: Tree) -> None:
    """Make the group of a supervisor, if it does not exist. Raises OSError."""
    os.makedirs(tree.top, exist_ok=True)
    if tree.version == 2:
        cgroups.enable(tree.top, tree.controllers)


def make_repeatedly(make: Callable[[], None]) -> None:
    """Make groups; again if another supervisor removes one of them. Raises OSError.

    A supervisor that starts removes the empty groups of all others.
    """
    for tries_left in reversed(range(_TRIES)):
        try:
            make()
        except FileNotFoundError:
            if not tries_left:
                raise
        else:
            return


def _offered(mount: cgroups.Mount) -> set[str]:
    """Return the controllers of a mount that are of use here."""
    if mount.version == 1:
        return set(_CONTROLLERS) & mount.controllers
    try:
        names = cgroups.read(os.path.join(mount.point, "cgroup.controllers")).split()
    except OSError:
        return set()
    return set(_CONTROLLERS) & set(names)


def _why_not(mount: cgroups.Mount, error: OSError, root: str) -> str:
    group = mount.point
    with contextlib.suppress(OSError):
        group = cgroups.own_group(mount, root) or group
    if error.errno == errno.EBUSY:
        reason = f"other processes are in the control group {group}, or it is not delegated"
    else:
        reason = f"no groups can be made below the control group {group}: {reason_of(error)}"
    return f"{reason}. To get it, {_HOW}"


def _missing(trees: list[Tree], faults: dict[str, str]) -> dict[str, str]:
    missing = {}
    for name in cgroups.LIMITING:
        if not any(name in tree.controllers for tree in trees):
            unmounted = f"the kernel offers no control group with {name}"
            if name == "memory":
                unmounted += " (on a Raspberry Pi, `cgroup_enable=memory` in cmdline.txt)"
            missing[f"limits.{name}"] = faults.get(name, unmounted)
    if "limits.memory" in missing:
        missing["limits.memory_high"] = missing["limits.memory"]
    elif any(tree.version == 1 and "memory" in tree.controllers for tree in trees):
        missing["limits.memory_high"] = "control groups of version 1 have no such limit"
    return missing


def _missing_rights() -> dict[str, str]:
    """Return the scheduling settings for which this process lacks the rights."""
    try:
        with open("/proc/self/status", encoding="utf-8") as file:
            lines = dict(line.split(":", 1) for line in file)
        if int(lines["CapEff"], 16) & _CAP_SYS_NICE:
            return {}
    except (OSError, ValueError, KeyError):
        pass
    missing = {}
    if not resource.getrlimit(resource.RLIMIT_RTPRIO)[0]:
        missing["realtime"] = "CAP_SYS_NICE or a limit `rtprio` (RLIMIT_RTPRIO) is required"
    # The limit is 20 less the niceness, so that 20 allows niceness 0. An unlimited one is -1.
    if resource.getrlimit(resource.RLIMIT_NICE)[0] in range(21):
        missing["nice"] = "CAP_SYS_NICE or a limit `nice` (RLIMIT_NICE) is required"
    return missing
