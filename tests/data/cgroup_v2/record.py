"""Records the control groups of this process: `python record.py DIRECTORY`."""

from __future__ import annotations

import sys
from pathlib import Path

from rosrm_resources.cgroups import find_group

NAMES = (
    "memory.current", "memory.max", "memory.high", "memory.stat",
    "cpu.max", "cpu.stat", "cpuset.cpus.effective",
)  # fmt: skip


def record(target: Path) -> None:
    for name in ("self/cgroup", "self/mountinfo", "meminfo", "stat"):
        copy(Path("/proc") / name, target)
    for controller in ("memory", "cpu", "cpuset"):
        group = find_group(controller)
        if group is None or group.version != 2:
            print(f"{controller}: {group}")
            continue
        for directory in group.upward():
            for name in NAMES:
                copy(directory / name, target)


def copy(source: Path, target: Path) -> None:
    """Copy a file of /proc; of the mounts only those of control groups, for privacy."""
    if not source.exists():
        return
    text = source.read_text()
    if source.name == "mountinfo":
        text = "".join(line for line in text.splitlines(keepends=True) if " - cgroup" in line)
    place = target / source.relative_to("/")
    place.parent.mkdir(parents=True, exist_ok=True)
    place.write_text(text)


if __name__ == "__main__":
    record(Path(sys.argv[1]))
