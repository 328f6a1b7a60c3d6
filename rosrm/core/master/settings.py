"""Settings of the master's core; `rosrm.config` fills them from the file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Final, Literal

from rosrm.model.values import EMPTY, ProcessSpec

Preemption = Literal["move", "requeue", False]

#: Key of the quota of each user without an entry of its own.
DEFAULT_QUOTA: Final = "default"


@dataclass(frozen=True, slots=True)
class CoreSettings:
    """Settings of the master's core.

    Attributes:
        backfill: True: processes may be placed before an earlier one that waits for room.
        default_needs: base units by resource, for a process without declared or learned needs.
        process_defaults: values of the fields that a submitted process leaves out; None: none.
        settle: seconds after which an estimate (not a declared need) no longer counts.
        suspect: seconds of silence after which a host gets no new work.
        lease: seconds of silence after which a host is lost.
        delivery_timeout: seconds within which a slave must accept an assignment.
        cooldown: seconds after a migration in which the core does not migrate a process again.
        hysteresis: seconds for which a host must be over a limit before an eviction.
        headroom: fraction by which a destination stays under each of its limits.
        need: need by which a destination is chosen. "measured": the larger one of the process's
            need and its measured usage; "declared": its need as at its first placement.
        max_migrations: highest number of migrations in flight.
        automatic: True: the core evicts processes from hosts that are over a limit.
        link_period: seconds between two measurements of the links of a host; 0: no measurements.
        learn_flows: True: slaves measure the flows between processes.
        preemption: way in which processes make room for one of a higher priority that fits on no
            host: "move" to other hosts; or "requeue", those that cannot move wait in the queue
            again; False: not at all.
        rebalance: True: the core moves processes to even out the load of the hosts.
        rebalance_spread: difference between the loads of two hosts from which on it does so.
        rebalance_after: seconds for which the difference must last, and between two rounds.
        rebalance_moves: most processes that move in one round.
        order_retry: seconds after which an unanswered order is repeated.
        progress_deadline: seconds for which a service of an application may wait for a host before
            its version fails; 0: no limit.
        keep_ended: number of the newest terminal processes that are not garbage-collected.
        keep_versions: number of the newest versions of each application that are kept.
        max_hosts: most hosts, also of those that left or are lost.
        max_processes: most processes that have not ended.
        quotas: limits by principal, or `DEFAULT_QUOTA`: "processes", and base units of
            "memory" and "cpu". A missing limit is that of the default.
    """

    backfill: bool = False
    default_needs: Mapping[str, float] = field(
        default_factory=lambda: MappingProxyType({"memory": 64 * 2.0**20, "cpu": 0.1})
    )
    process_defaults: ProcessSpec | None = None
    settle: float = 10.0
    suspect: float = 1.0
    lease: float = 10.0
    delivery_timeout: float = 5.0
    cooldown: float = 30.0
    hysteresis: float = 2.0
    headroom: float = 0.05
    need: Literal["measured", "declared"] = "measured"
    max_migrations: int = 2
    automatic: bool = True
    link_period: float = 10.0
    learn_flows: bool = True
    preemption: Preemption = "move"
    rebalance: bool = False
    rebalance_spread: float = 0.3
    rebalance_after: float = 60.0
    rebalance_moves: int = 4
    order_retry: float = 2.0
    progress_deadline: float = 600.0
    keep_ended: int = 10_000
    keep_versions: int = 5
    max_hosts: int = 2_000
    max_processes: int = 10_000
    quotas: Mapping[str, Mapping[str, float]] = field(default_factory=lambda: EMPTY)
