"""Journal stall: readings that arrive while no decision can be made durable.

The core's own clock stops during a stall. So no deadline passes, and no host becomes lost because
of a full disk. Deadlines continue where they were when the stall ends.
"""

from __future__ import annotations

import numpy as np

from rosrm.core.master import events as happened
from rosrm.core.master.hosts.liveness import mark_up
from rosrm.core.master.hosts.readings import take_readings
from rosrm.core.master.master_state import MasterState
from rosrm.core.master.state.hosts import HostCondition


def note_readings(state: MasterState, event: happened.ReadingsReceived, now: float) -> None:
    """Store a batch of readings: they renew the last contact of hosts, and decide nothing.

    A suspect host becomes up again, and the next beat shows it so; otherwise instances there might
    have to stop. The rejoin of a lost host needs a decision, so the host stays lost.
    """
    take_readings(state.hosts, event, now)
    table = state.hosts
    in_contact = (table.condition == HostCondition.SUSPECT) & (table.last_contact >= now)
    for column in np.flatnonzero(in_contact):
        mark_up(state, table.hosts[column], now)
