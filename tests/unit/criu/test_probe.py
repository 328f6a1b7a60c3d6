"""The test of CRIU on a host, with programs in place of CRIU."""

from __future__ import annotations

import time

from rosrm_criu.engine.binary import CriuBinary
from rosrm_criu.engine.probe import probe

#: Like a restore that is killed: a process that left its session keeps the cleaner's pipe open.
LEAVES_A_PROCESS = "#!/bin/sh\nsetsid sleep 10 &\nexit 1\n"


def test_a_process_that_criu_leaves_delays_the_answer_only_for_a_moment(tmp_path):
    """The slave waits for the answer; the cleaner waits on for that process."""
    program = tmp_path / "criu"
    program.write_text(LEAVES_A_PROCESS)
    program.chmod(0o700)
    began = time.monotonic()
    found = probe(CriuBinary((str(program),), "4.2.1"), timeout=5.0)
    assert not found.works
    assert time.monotonic() - began < 8.0
