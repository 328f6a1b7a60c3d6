"""Labs of real virtual hosts, with a check that nothing of them is left on the machine."""

from __future__ import annotations

import os
import subprocess
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from rosrm.errors import LabError
from rosrm_lab import MIB, Lab, needs, store, uniform


def why_not() -> str:
    """Return the missing requirement of a lab; "" if all are met.

    The function creates no lab. If nothing is missing, a lab that cannot be created is an error, no
    reason to skip.
    """
    from rosrm_lab import groups

    try:
        needs.check_rights()
        hierarchies = groups.find_hierarchies()
        needs.check_machine([], store.IMAGES, hierarchies)
        needs.check_commands()
    except LabError as error:
        return str(error).splitlines()[0]
    sealed = [str(one.mount) for one in hierarchies if not os.access(one.mount, os.W_OK)]
    return f"read-only control groups: {', '.join(sealed)}" if sealed else ""


@pytest.fixture(scope="session", autouse=True)
def lab_is_possible():
    reason = why_not()
    if reason:
        pytest.skip(f"needs root and what a lab is made of: {reason}")


#: Marks of the mounts that other labs and tests make and remove at any time. pyroute2, like `ip`,
#: makes /run/netns a mount point with the first namespace, permanently; CRIU checks the kernel.
_OF_OTHERS = frozenset({"rosrm-lab", "/run/netns", "/pytest-of-", "criu.move_mount_set_group"})


def remains(lab: str) -> dict[str, set[str]]:
    """Return all traces on this machine that a lab could leave; other labs may appear any time."""
    losetup = ["losetup", "-n", "-O", "BACK-FILE"]
    loops = subprocess.run(losetup, capture_output=True, text=True, check=True).stdout.splitlines()
    mounts = Path("/proc/self/mounts").read_text().splitlines()
    commands = {_text(path) for path in Path("/proc").glob("[0-9]*/cmdline")}
    return {
        "namespaces": {path.name for path in Path("/run/netns").glob(f"rosrm-lab:{lab}*")},
        "mounts": {line for line in mounts if lab in line or not _OF_OTHERS & _words(line)},
        "groups": _below(Path("/sys/fs/cgroup"), lab),
        "processes": {line for line in commands if lab in line and "rosrm_lab/inside" in line},
        "loops": {line for line in loops if lab in line},
        "files": _below(store.RUN, lab) | _below(store.IMAGES, lab),
    }


@contextmanager
def leaves_nothing(lab: str) -> Iterator[None]:
    """Check that a lab is gone after a block as if it had never been made."""
    before = remains(lab)
    yield
    assert remains(lab) == before


def _below(root: Path, start: str) -> set[str]:
    """Return the paths below a folder whose name starts with `start`."""
    # `os.walk` skips a folder of another lab that is removed during the walk; `rglob` raises.
    return {
        f"{folder}/{name}"
        for folder, folders, files in os.walk(root)
        for name in (*folders, *files)
        if name.startswith(start)
    }


def _words(line: str) -> set[str]:
    """Return the target of a mount, and which of the marks of `_OF_OTHERS` are in its line."""
    return {line.split()[1]} | {mark for mark in _OF_OTHERS if mark in line}


def _text(path: Path) -> str:
    try:
        return path.read_bytes().replace(b"\0", b" ").decode(errors="replace")
    except OSError:
        return ""


@pytest.fixture
def name():
    """Yield the name of a lab; check after the test that nothing of the lab is left."""
    chosen = f"t-{uuid.uuid4().hex[:8]}"
    with leaves_nothing(chosen):
        yield chosen
        Lab(chosen).down()


@pytest.fixture
def lab(name):
    """Yield a lab of two small hosts, and of one without a quota."""
    from rosrm_lab import HostPlan

    hosts = uniform(2, memory=128 * MIB, cpu=0.5, disk=32 * MIB)
    with Lab(name, [*hosts, HostPlan("desk", disk=32 * MIB)]) as made:
        yield made
