"""Threads of calls of launchers that may hang."""

import threading
from queue import SimpleQueue

from rosrm.slave.launch.lanes import Lanes
from tests.garbage import cyclic_garbage
from tests.waiting import PATIENCE


def test_a_call_that_has_ended_is_freed_without_a_collection_of_garbage():
    """Nothing refers to itself; a slave starts thousands of processes between two collections."""
    posted, outcomes, before = SimpleQueue(), [], set(threading.enumerate())
    lanes = Lanes(posted.put, limit=PATIENCE)
    with cyclic_garbage() as left:
        lanes.run("python", lambda: 7, outcomes.append)
        posted.get(timeout=PATIENCE)()
        assert outcomes == [7]
        for thread in set(threading.enumerate()) - before:
            thread.join(PATIENCE)
        del thread
    assert "rosrm.slave.launch.lanes" not in {one.__module__ for one in left}
