"""Requirements of a lab on this machine, and the advice where one is missing."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Final

import psutil

from rosrm.errors import LabError
from rosrm_lab import groups
from rosrm_lab.plan import MIB, HostPlan, total

#: Bits of the capabilities (linux/capability.h), and the purpose of each.
CAPABILITIES: Final = {
    "CAP_DAC_OVERRIDE": (1, "to keep the lab's files"),
    "CAP_KILL": (5, "to end the processes of a host"),
    "CAP_SETGID": (6, "to act as another user"),
    "CAP_SETUID": (7, "to act as another user"),
    "CAP_NET_ADMIN": (12, "for bridges, cables and firewalls"),
    "CAP_SYS_CHROOT": (18, "to enter a host"),
    "CAP_SYS_ADMIN": (21, "for namespaces, mounts and control groups"),
}
#: Programs, and the Debian package of each.
COMMANDS: Final = {
    "mkfs.ext4": "e2fsprogs",
    "mount": "mount",
    "nft": "nftables",
    "nsenter": "util-linux",
    "setpriv": "util-linux",
    "unshare": "util-linux",
}
#: `nft` is only required when a network is changed.
FROM_THE_START: Final = ("mkfs.ext4", "mount", "nsenter", "setpriv", "unshare")
#: Makes loop devices, with which disks are mounted.
_DEVICE: Final = Path("/dev/loop-control")
#: Their folders, because the PATH of an ordinary user, or of sudo, may lack some.
_PLACES: Final = "/usr/local/sbin:/usr/sbin:/sbin:/usr/local/bin:/usr/bin:/bin"

WITHOUT_ROOT: Final = (
    "Without root, several slaves on this host can share it as slices, each with a capacity of its "
    "own that is measured, not enforced. Write one file a host, such as\n"
    "  {name}.yaml:  {{host: {name}, scope: slice, budget: {{memory: {memory}, cpu: {cpu:g}, "
    "disk: {disk}}}}}\n"
    "and start each with `rosrm slave --config {name}.yaml`, in one ROS domain with "
    "ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST"
)


def find_command(name: str) -> str:
    """Return the path of a program; raises `LabError` with the package that contains it."""
    found = shutil.which(name, path=f"{os.environ.get('PATH', '')}:{_PLACES}")
    if found is None:
        raise LabError(
            f"the command {name!r} is missing. On Debian and Ubuntu: "
            f"apt-get install {COMMANDS.get(name, name)}"
        )
    return found


def check_commands(names: Iterable[str] = tuple(COMMANDS)) -> None:
    """Raise `LabError` where a program is missing; default: any that a lab may need."""
    for name in names:
        find_command(name)


def check_rights(hosts: Sequence[HostPlan] = (), status: str | None = None) -> None:
    """Raise `LabError` where a capability is missing; the text also shows a way without it.

    Args:
        hosts: of the lab: the way without root is shown for the first.
        status: content of /proc/self/status.
    """
    text = status if status is not None else Path("/proc/self/status").read_text()
    effective = int(text.split("CapEff:", 1)[1].split(None, 1)[0], 16)
    missing = [name for name, (bit, _) in CAPABILITIES.items() if not effective >> bit & 1]
    if not missing:
        return
    reasons = "; ".join(f"{name} {CAPABILITIES[name][1]}" for name in missing)
    if os.geteuid() == 0:
        remedy = "This root is that of a container: `docker run --privileged` gives them"
    else:
        remedy = "Run it as root (`sudo`)"
    raise LabError(f"a lab needs rights that are missing: {reasons}. {remedy}.\n{_slices(hosts)}")


def check_machine(
    hosts: Sequence[HostPlan], images: Path, hierarchies: Iterable[groups.Hierarchy] = ()
) -> None:
    """Raise `LabError` where a program, a device, memory or disk space is missing.

    Args:
        hosts: of the lab.
        images: the directory for their disks.
        hierarchies: of their groups: a container may have a limit of its own there.
    """
    check_commands(FROM_THE_START)
    if not _DEVICE.exists():
        raise LabError(
            f"there are no loop devices ({_DEVICE}): the hosts' disks cannot be mounted. "
            "`modprobe loop` brings them; a container needs `docker run --privileged -v /dev:/dev`"
        )
    _check_memory(hosts, hierarchies)
    _check_space(hosts, images)


def overbooked(hosts: Sequence[HostPlan]) -> str:
    """Return a warning where the hosts may use more cores together than there are; else ""."""
    cores, wanted = psutil.cpu_count() or 1, total(host.cpu for host in hosts)
    if wanted <= cores:
        return ""
    return (
        f"the hosts may use {wanted:g} cores together and this machine has {cores}: when all are "
        "busy, each gets less than its share"
    )


def _check_memory(hosts: Sequence[HostPlan], hierarchies: Iterable[groups.Hierarchy]) -> None:
    wanted = total(host.memory for host in hosts)
    available, where = psutil.virtual_memory().available, "on this machine"
    left = groups.memory_left(hierarchies)
    if left is not None and left < available:
        available, where = left, "within the limit of this container"
    if wanted > available:
        raise LabError(
            f"the hosts may use {wanted / MIB:.0f} MiB of memory together, and "
            f"{available / MIB:.0f} MiB are available {where}: ask for fewer or smaller hosts"
        )


def _check_space(hosts: Sequence[HostPlan], images: Path) -> None:
    while not images.exists():
        images = images.parent
    free, wanted = shutil.disk_usage(images).free, total(host.disk for host in hosts)
    if wanted > free:
        raise LabError(
            f"the hosts' disks have {wanted / MIB:.0f} MiB together, and {free / MIB:.0f} MiB are "
            f"free under {images}: ask for fewer hosts or smaller disks"
        )


def _slices(hosts: Sequence[HostPlan]) -> str:
    first = hosts[0] if hosts else HostPlan("host1")
    memory = f"{(first.memory or 1024 * MIB) // MIB}MiB"
    return WITHOUT_ROOT.format(
        name=first.name, memory=memory, cpu=first.cpu or 1.0, disk=f"{first.disk // MIB}MiB"
    )
