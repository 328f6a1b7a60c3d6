"""Repetition of a lost request by Fast DDS, between real participants in two processes."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tests.programs import needs

PROGRAM = Path(__file__).parent / "programs" / "lost_request.py"
#: Seconds: less than with the default settings of Fast DDS, and long for a busy machine.
QUICK = 2.0


@needs("nft")
@pytest.mark.parametrize("pace", ["eager", "steady"])
def test_a_lost_request_is_repeated_by_its_writer(pace):
    """By default the writer of a request sends a heartbeat, which shows the loss, after 3 s."""
    done = subprocess.run(
        [sys.executable, PROGRAM, pace], capture_output=True, text=True, check=True, timeout=90
    )
    if done.stdout == "not permitted\n":
        pytest.skip("a private network needs CAP_SYS_ADMIN and CAP_NET_ADMIN")
    assert float(done.stdout) < QUICK
