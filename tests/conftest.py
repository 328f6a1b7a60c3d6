"""What all tests share: each is marked with the folder that it lies in."""

from __future__ import annotations

import os
import signal
from pathlib import Path
from typing import Any

import pytest
from hypothesis import settings

from tests.criu_kit import criu, theatre  # noqa: F401 - fixtures of several layers

HERE = Path(__file__).parent

#: Whose tests make labs: one at a time is enough for a machine, and only its own may come and go.
LABS = tuple(f"tests/integration/{one}" for one in ("lab/", "test_chaos.py", "test_paper.py"))

# By default DDS multicasts on every interface: what a test starts stays on this machine.
os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")

# Under `nohup` a program ignores SIGHUP, its children inherit that, and rosrm respects it.
# Children do not inherit a handler: the tests still ignore SIGHUP, the programs they start do not.
if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN:
    signal.signal(signal.SIGHUP, lambda *_: None)

# Where `make setup` has put CRIU, if it could be had.
os.environ.setdefault("ROSRM_CRIU_PREFIX", str(HERE.parent / ".venv/criu"))

# A busy machine may take its time for one example.
settings.register_profile("rosrm", deadline=None)
settings.load_profile("rosrm")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        layer = item.path.relative_to(HERE).parts[0]
        item.add_marker(getattr(pytest.mark, layer))
    # What takes long comes first: where two workers take file by file, none has it left at the end.
    slow = {item.path for item in items if item.get_closest_marker("slow")}
    items.sort(key=lambda item: item.path not in slow)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Workers that take file by file (`--dist loadfile`) take the labs as if they were one."""
    if config.getoption("dist") != "loadfile":
        return None
    from xdist.scheduler import LoadFileScheduling

    class Scheduling(LoadFileScheduling):
        def _split_scope(self, nodeid: str) -> str:
            return "labs" if nodeid.startswith(LABS) else super()._split_scope(nodeid)

    return Scheduling(config, log)
