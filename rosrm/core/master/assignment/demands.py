"""Demands of queued processes, and the rankings of the hosts for them; both are cached."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from rosrm.core.master.assignment.flows import traffic_of
from rosrm.core.master.assignment.neighbours import neighbours_of
from rosrm.core.master.master_state import MasterState
from rosrm.core.master.scheduling.ranking import Ranking
from rosrm.core.master.state.demand import Demand, RankingKey
from rosrm.core.master.state.process import Process

#: Number of rankings above which new readings remove all of them, as most are not needed again.
_MOST_KEPT: Final = 64


def demand_of(state: MasterState, process: Process) -> Demand:
    """Return the demand of a process.

    A change of the learned needs, of the hosts with a replica of its snapshot, of the hosts of its
    neighbours, or of its flows rebuilds it.
    """
    version = state.learned.version
    near = state.replication.replicas.hosts_of(process.name, process.born)
    neighbours, traffic = neighbours_of(state, process), traffic_of(state, process)
    known = process.demand
    if (
        known is None
        or known[0] != version
        or known[1].near != near
        or known[1].neighbours != neighbours
        or known[1].traffic != traffic
    ):
        needs = state.estimate(process.spec)
        demand = Demand(
            process.spec, needs.amounts, needs.estimated, process.forbidden_hosts, near=near,
            neighbours=neighbours, traffic=traffic, plugins=state.placement,
        )  # fmt: skip
        # Equal processes share one demand, because thousands of them may wait.
        known = process.demand = (version, state.demands.setdefault(demand.key, demand))
    return known[1]


def ranking_of(state: MasterState, demand: Demand) -> Ranking:
    """Return the current ranking of all hosts for a demand.

    Assignments and readings update it in place; other changes of the hosts make it void.
    """
    if state.rankings_version != state.hosts.version:
        state.rankings = _kept(state.rankings)
        state.demands.clear()
        state.rankings_version = state.hosts.version
    ranking = state.rankings.get(demand.key)
    if ranking is not None:
        ranking.refresh()
    elif demand.key is not demand.key_alone:
        known = state.rankings.get(demand.key_alone)
        alone = ranking_of(state, known.demand if known else demand.alone())
        ranking = state.rankings[demand.key] = alone.beside(demand)
    else:
        ranking = Ranking(state.hosts, demand)
        state.rankings[demand.key] = ranking
    return ranking


def _kept(rankings: Mapping[RankingKey, Ranking]) -> dict[RankingKey, Ranking]:
    """Return the rankings to which only readings and assignments have come since they were made."""
    if len(rankings) > _MOST_KEPT:
        return {}
    return {key: ranking for key, ranking in rankings.items() if ranking.outlasts_readings()}
