"""What may be taken in while nothing can be decided, because no decision could be made durable.

Time stands still for the core meanwhile: its clock is not that of the outside. So no deadline
passes and no host falls silent because of a full disk; what was due is due when it goes on.
"""

from __future__ import annotations

import numpy as np

from rosrm.core.master import events as happened
from rosrm.core.master.hosts.liveness import welcome_back
from rosrm.core.master.hosts.readings import take_readings
from rosrm.core.master.master_state import MasterState
from rosrm.core.master.state.hosts import HostCondition


def note_readings(state: MasterState, event: happened.ReadingsReceived, now: float) -> None:
    """Note a batch of readings: they tell which hosts live, and decide nothing by themselves.

    A host that was suspect is heard again, and is told so with the next beat: what runs there may
    have to stop otherwise. What a lost one brings back must be decided: it stays lost.
    """
    take_readings(state.hosts, event, now)
    table = state.hosts
    heard = (table.condition == HostCondition.SUSPECT) & (table.heard >= now)
    for column in np.flatnonzero(heard):
        welcome_back(state, table.hosts[column], now)
