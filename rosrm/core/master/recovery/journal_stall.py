"""Journal stall: handling of readings while the journal cannot be written.

The core's clock stops during a stall, so that no deadline passes and no host becomes lost because
of a full disk. After the stall, each deadline has the time left that it had before.
"""

from __future__ import annotations

import numpy as np

from rosrm.core.master import events as happened
from rosrm.core.master.hosts.liveness import mark_up
from rosrm.core.master.hosts.readings import take_readings
from rosrm.core.master.master_state import MasterState
from rosrm.core.master.state.hosts import HostCondition


def note_readings(state: MasterState, event: happened.ReadingsReceived, now: float) -> None:
    """Store a batch of readings: renew the last contact of hosts, and place nothing.

    A suspect host becomes up again, so that the next beat does not name it; otherwise its fences
    would expire. The rejoin of a lost host needs a durable decision, so the host stays lost.
    """
    take_readings(state.hosts, event, now)
    table = state.hosts
    in_contact = (table.condition == HostCondition.SUSPECT) & (table.last_contact >= now)
    for column in np.flatnonzero(in_contact):
        mark_up(state, table.hosts[column], now)
