"""Marks, order and distribution of all tests."""

from __future__ import annotations

import atexit
import functools
import os
import shutil
import signal
import tempfile
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
from hypothesis import settings

from rosrm.runtime import cgroups
from rosrm.supervisor.group_trees import PREFIX
from rosrm.supervisor.instance_groups import remove_empty
from tests.cpp.core_library import cpp_core  # noqa: F401 - fixture of several layers
from tests.criu_kit import criu, theatre  # noqa: F401 - fixtures of several layers

HERE = Path(__file__).parent

#: Tests that take much memory and CPU, in groups: each runs on one worker, so that no more than two
#: labs run at once. The benchmarks measure, on labs that each take a minute. The tests of
#: controllers switch them for the group above all tests. All files with the fixture of a browser
#: are another such group.
GROUPS = {
    "labs": ("tests/integration/lab/",),
    "benchmarks": ("tests/integration/test_chaos.py", "tests/integration/test_paper.py"),
    "controllers": ("tests/integration/supervisor/test_cgroup_v2.py",),
}
BROWSER = "chromium"

#: Tests of a ROS graph that together take as long as a slow one.
SLOW = 6

# By default DDS multicasts on every interface: what a test starts stays on this machine.
os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")

# The keys of all tests, in a directory of their own.
if "ROSRM_KEYS" not in os.environ:
    _keys = tempfile.TemporaryDirectory(prefix="rosrm-keys-")
    atexit.register(_keys.cleanup)
    os.environ["ROSRM_KEYS"] = _keys.name

# Where `make setup` has put CRIU, if it could be had.
os.environ.setdefault("ROSRM_CRIU_PREFIX", str(HERE.parent / ".venv/criu"))

# pytest imports readline, which sets these for the workers of xdist; tables in pipes obey them.
for _size in ("COLUMNS", "LINES"):
    os.environ.pop(_size, None)

# A busy machine may take its time for one example.
settings.register_profile("rosrm", deadline=None)
settings.load_profile("rosrm")


# `nohup` and shells without job control start programs that ignore these signals. What a test
# starts would inherit that, and rosrm respects it. A handler is not inherited.
for _number in (signal.SIGHUP, signal.SIGINT, signal.SIGQUIT):
    if signal.getsignal(_number) is signal.SIG_IGN:
        signal.signal(_number, lambda *_: None)


def pytest_report_header() -> list[str]:
    """Name, before the first test, what this machine lacks and which tests are skipped for it."""
    lab = "virtual hosts (tests/integration/lab, the chaos and paper benchmarks)"
    kitti = os.environ.get("ROSRM_KITTI") or HERE.parent / "../shared/data/kitti"
    no_kitti = not Path(kitti).is_dir()
    lacking = {
        "root": (os.geteuid() != 0, f"{lab}, private networks, full disks"),
        "nft (package nftables)": (shutil.which("nft") is None, lab),
        "mkfs.ext4 (package e2fsprogs)": (shutil.which("mkfs.ext4") is None, lab),
        "a drive of KITTI (ROSRM_KITTI=folder)": (no_kitti, "SLAM on real scans"),
    }  # fmt: skip
    return [
        f"not here: {what}; skipped: {tests}" for what, (lacks, tests) in lacking.items() if lacks
    ]


def pytest_sessionfinish() -> None:
    """Remove the control groups of supervisors that tests have killed.

    Those with processes stay. A supervisor whose empty group is removed makes it again.
    """
    for mount in cgroups.mounts():
        own = cgroups.own_group(mount)
        for top in Path(own).glob(f"{PREFIX}*") if own else ():
            remove_empty(str(top))


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        layer = item.path.relative_to(HERE).parts[0]
        item.add_marker(getattr(pytest.mark, layer))
    # The longest unit of work comes first, so that no worker has it left at the end.
    unit_of = {item: unit_of_work(item.nodeid) for item in items}
    length: Counter[str] = Counter()
    for item in items:
        length[unit_of[item]] += SLOW if item.get_closest_marker("slow") else 1
    items.sort(key=lambda item: -length[unit_of[item]])


def unit_of_work(nodeid: str) -> str:
    """Return the name of the tests that run one after the other on one worker."""
    for name, places in GROUPS.items():
        if nodeid.startswith(places):
            return name
    file = nodeid.partition("::")[0]
    source = source_of(file)
    if f"({BROWSER}" in source:
        return BROWSER
    # The tests of a file share what a fixture starts, such as a cluster.
    return file if 'scope="module"' in source else nodeid


@functools.cache
def source_of(file: str) -> str:
    """Return the source of a file with tests."""
    return (HERE.parent / file).read_text(encoding="utf-8")


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Let `--dist loadscope` distribute units of work, in the order in which they are collected."""
    if config.getoption("dist") != "loadscope":
        return None
    from xdist.scheduler import LoadScopeScheduling

    class Scheduling(LoadScopeScheduling):
        def _split_scope(self, nodeid: str) -> str:
            return unit_of_work(nodeid)

    return Scheduling(config, log)
