"""State of a lab between two commands: one file each, under /run/rosrm-lab.

The file has the plan, the first process of each host, and the faults of the network. All that a
command makes on the machine can be found and removed without the file.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import socket
import time
from collections.abc import Iterator, Mapping
from dataclasses import astuple, dataclass, field
from pathlib import Path
from typing import Any, Final

from rosrm import clocks
from rosrm.errors import LabError
from rosrm.runtime.private_files import make_private_directory, open_private
from rosrm.supervisor.procfs import read_stat
from rosrm.wording import reason_of
from rosrm_lab import wires
from rosrm_lab.plan import PREFIX, LabPlan
from rosrm_lab.wires import Link

RUN: Final = Path("/run") / PREFIX
#: Folder of the disks: on a real file system, because /run is in memory.
IMAGES: Final = Path("/var/lib") / PREFIX

_VERSION: Final = 1
_FILE: Final = "lab.json"
_LOOK: Final = 0.05


@dataclass(frozen=True, slots=True)
class Birth:
    """The identity of a process, different from that of a later process with the same pid.

    Attributes:
        pid: its number.
        started: clock ticks since the machine's boot.
    """

    pid: int
    started: int

    @classmethod
    def of(cls, pid: int) -> Birth | None:
        """Return the identity of a live process; None: there is none."""
        stat = read_stat(pid)
        return cls(pid, stat.start) if stat is not None and stat.alive else None

    @property
    def alive(self) -> bool:
        """Return True if the process is alive."""
        return Birth.of(self.pid) == self


@dataclass(slots=True)
class LabRecord:
    """The state of a lab in its file.

    Attributes:
        plan: hosts and network.
        complete: it was made completely; else it is being made, or that was interrupted.
        boot: the boot of the machine in which it was made.
        owner: the process whose end makes the lab an abandoned one; None: it stays.
        inits: the first process of each host that was booted.
        links: faults of the hosts' network.
    """

    plan: LabPlan
    complete: bool = False
    boot: str = ""
    owner: Birth | None = None
    inits: dict[str, Birth] = field(default_factory=dict)
    links: dict[str, Link] = field(default_factory=dict)

    def is_up(self, host: str) -> bool:
        """Return True if a host is switched on."""
        birth = self.inits.get(host)
        return birth is not None and birth.alive

    def outside(self, host: str, path: Path) -> Path:
        """Return the path on this machine of a file of a host that is up."""
        return Path(f"/proc/{self.inits[host].pid}/root") / str(path).lstrip("/")

    def to_plain(self) -> dict[str, Any]:
        """Return the content of the file."""
        return {
            "version": _VERSION,
            "plan": self.plan.to_plain(),
            "complete": self.complete,
            "boot": self.boot,
            "owner": self.owner and astuple(self.owner),
            "inits": {name: astuple(birth) for name, birth in self.inits.items()},
            "links": wires.to_plain(self.links),
        }

    @classmethod
    def from_plain(cls, plain: Mapping[str, Any]) -> LabRecord:
        """Build a record from the result of `to_plain`."""
        if plain["version"] != _VERSION:
            raise ValueError(f"version {plain['version']}")
        owner = plain["owner"]
        return cls(
            plan=LabPlan.from_plain(plain["plan"]),
            complete=bool(plain["complete"]),
            boot=str(plain["boot"]),
            owner=Birth(*owner) if owner else None,
            inits={name: Birth(*birth) for name, birth in plain["inits"].items()},
            links=wires.from_plain(plain["links"]),
        )


def read(lab: str) -> LabRecord | None:
    """Return the state of a lab; None: there is none, or it is unreadable."""
    try:
        return LabRecord.from_plain(json.loads((RUN / lab / _FILE).read_text()))
    except (OSError, ValueError, KeyError, TypeError):
        return None


def write(record: LabRecord) -> None:
    """Write the state of a lab; a reader sees the old or the new file, never a part."""
    folder = RUN / record.plan.name
    make_private_folder(folder)
    part = folder / f"{_FILE}.part"
    flags = os.O_WRONLY | os.O_CREAT | os.O_TRUNC
    with os.fdopen(open_private(str(part), flags), "w", encoding="utf-8") as file:
        file.write(json.dumps(record.to_plain()))
    part.replace(folder / _FILE)


def make_private_folder(folder: Path) -> None:
    """Create the folder of a lab below `RUN` or `IMAGES`, both for the lab's user alone.

    Raises:
        LabError: it cannot be created, or belongs to another user.
    """
    try:
        make_private_directory(folder.parent)
        make_private_directory(folder)
    except OSError as error:
        raise LabError(f"the folder {folder} cannot be used: {reason_of(error)}") from None


def image(lab: str, host: str) -> Path:
    """Return the file of a host's disk."""
    return IMAGES / lab / f"{host}.ext4"


def forget(lab: str) -> None:
    """Remove all files of a lab; that of its state last."""
    for folder in (IMAGES / lab, RUN / lab):
        if folder.exists():
            shutil.rmtree(folder)
        with contextlib.suppress(OSError):  # other labs have files in it
            folder.parent.rmdir()


def labs() -> set[str]:
    """Return the labs that have files."""
    return {
        entry.name
        for folder in (RUN, IMAGES)
        if folder.is_dir()
        for entry in folder.iterdir()
        if entry.is_dir()
    }


@contextlib.contextmanager
def lock(name: str, timeout: float = 30.0) -> Iterator[None]:
    """Let one command at a time change a lab; the lock is released at the end of its process.

    Args:
        name: of the lab; "" for changes that concern all labs.
        timeout: seconds to wait for another command.
    """
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as claim:
        deadline = clocks.boot_time() + timeout
        while True:
            try:
                claim.bind(f"\0{PREFIX}:{name}")
                break
            except OSError:
                if clocks.boot_time() > deadline:
                    raise LabError(
                        f"another command is at work on lab {name!r}, for more than {timeout:g} s: "
                        "wait for its end, or end it"
                    ) from None
                time.sleep(_LOOK)  # there is no event when a name becomes free
        yield
