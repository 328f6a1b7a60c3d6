"""Threads of calls of launchers that may hang."""

import gc
import threading
from queue import SimpleQueue

from rosrm.slave.launch.lanes import Lanes
from tests.waiting import PATIENCE


def test_a_call_that_has_ended_is_freed_without_a_collection_of_garbage():
    """Nothing refers to itself; a slave starts thousands of processes between two collections."""
    posted, outcomes, before = SimpleQueue(), [], set(threading.enumerate())
    lanes = Lanes(posted.put, limit=PATIENCE)
    gc.collect()
    gc.disable()
    try:
        lanes.run("python", lambda: 7, outcomes.append)
        posted.get(timeout=PATIENCE)()
        assert outcomes == [7]
        for thread in set(threading.enumerate()) - before:
            thread.join(PATIENCE)
        del thread
        gc.set_debug(gc.DEBUG_SAVEALL)
        gc.collect()
        kinds = {type(one).__module__ for one in gc.garbage}
    finally:
        gc.set_debug(0)
        gc.garbage.clear()
        gc.enable()
    assert "rosrm.slave.launch.lanes" not in kinds
