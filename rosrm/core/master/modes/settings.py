"""Limits of hosts, and weights of scoring policies, while a mode is in force."""

from __future__ import annotations

from dataclasses import replace

from rosrm.core.master.master_state import MasterState
from rosrm.errors import RosrmError
from rosrm.extensions.placement import PolicySettings
from rosrm.model.modes import Mode


def apply_settings(state: MasterState) -> None:
    """Apply the limits and weights of the mode in force."""
    mode = state.modes.mode
    state.hosts.set_ceilings({} if mode is None else mode.limits)
    scoring = state.scoring if mode is None else weighted(state, mode)
    if state.chain_of is None or scoring == state.scoring_in_force:
        return
    try:
        chain = state.chain_of(scoring)
    except RosrmError as fault:  # the plugins may be others than when the mode was loaded
        if mode is not None:
            state.modes.fault[mode.name] = f"its weights do not apply: {fault}"
        return
    state.placement, state.scoring_in_force = replace(state.placement, chain=chain), scoring
    for process in state.processes.values():
        process.demand = None  # it has the former policies
    state.hosts.changed()


def weighted(state: MasterState, mode: Mode) -> tuple[PolicySettings, ...]:
    """Return the settings of the scoring policies with the weights of a mode."""
    if not mode.weights:
        return state.scoring
    return tuple(
        replace(one, options={**one.options, "weights": dict(mode.weights)})
        if "weights" in one.options else one
        for one in state.scoring
    )  # fmt: skip
