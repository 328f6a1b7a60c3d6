"""Hosts and processes for tests of policies and filters; the contract of scoring policies."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from typing import Any, ClassVar, Final

import numpy as np
import numpy.typing as npt

from rosrm.core.master.scheduling.host_views import checked_scores
from rosrm.extensions.array_types import BoolArray
from rosrm.extensions.contracts import (
    HostView,
    ProcessView,
    Scores,
    ScoringOffer,
    ScoringPolicy,
)
from rosrm.extensions.declared_fields import FLOWS_FIELD, SPEC_FIELDS, declared_spec
from rosrm.extensions.link_views import FlowView, no_flows
from rosrm.extensions.plugin_calls import required
from rosrm.extensions.time_limit import CALL_LIMIT
from rosrm.model.devices import DeviceNeed
from rosrm.model.values import EMPTY, Kind, MigrationPolicy, ProcessSpec
from rosrm.testing.calls import call, made


def host_view(
    usage: Mapping[str, Sequence[float]],
    *,
    limit: float = 1.0,
    capacity: float = 1.0,
    processes: Sequence[int] = (),
    labels: Sequence[Mapping[str, str]] = (),
    devices: Sequence[Mapping[str, float]] = (),
    tenants: Sequence[Sequence[str]] = (),
) -> HostView:
    """Return hosts h0, h1, ... for a scoring policy.

    Args:
        usage: by resource, one fraction for each host; NaN: the host lacks the resource.
        limit: of every resource on every host, fraction.
        capacity: of every resource on every host, base units.
        processes: number of processes by host; (): 0 on every host.
        labels: by host; (): no labels.
        devices: number of free units by kind, by host; (): no devices.
        tenants: names of the processes by host; (): none.
    """
    # The core stores one row for each resource, and a policy gets the transpose, as here.
    table = np.array(list(usage.values()), np.float64).reshape(len(usage), -1)
    missing = np.isnan(table)
    hosts = table.shape[1]
    return HostView(
        names=[f"h{host}" for host in range(hosts)],
        resources=tuple(usage),
        usage=table.T,
        limit=np.full_like(table, limit).T,
        capacity=np.where(missing, np.nan, capacity).T,
        processes=np.array(processes or [0] * hosts, np.int64),
        labels=labels or [EMPTY] * hosts,
        devices=devices or [EMPTY] * hosts,
        tenants=[{name: ProcessSpec(name) for name in names} for names in tenants or [()] * hosts],
    )


def process_view(
    hosts: HostView,
    needs: Mapping[str, float] = EMPTY,
    *,
    flows: FlowView | None = None,
    reads: tuple[str, ...] = SPEC_FIELDS,
    **spec: Any,
) -> ProcessView:
    """Return a process to place, for a scoring policy.

    Args:
        hosts: candidates for the placement.
        needs: base units by resource.
        flows: with other processes, see `flow_view`; None: there are none.
        reads: fields of the spec that the policy's offer declares; the default is all of them.
        spec: fields of the spec, e.g. `name="camera_0"` or `environment={"GROUP": "camera"}`.
    """
    fields = {"name": "p", "command": ("true",), "needs": dict(needs), **spec}
    need = np.zeros(hosts.usage.shape[::-1])
    for name, amount in needs.items():
        if name in hosts.resources:
            row = hosts.resources.index(name)
            part = amount / hosts.capacity[:, row]
            need[row] = np.where(np.isnan(part), np.inf if amount > 0 else 0.0, part)
    return ProcessView(declared_spec(ProcessSpec(**fields), reads), need.T, flows or no_flows())


def flow_view(
    rates: Mapping[str, float],
    *,
    local: Sequence[Sequence[bool]],
    link: Sequence[Sequence[float]],
    load: Sequence[Sequence[float]] | None = None,
    round_trip: Sequence[Sequence[float]] | None = None,
    limit: float = 1.0,
) -> FlowView:
    """Return the flows of a process, for a scoring policy.

    Args:
        rates: by name of the other process, bytes a second.
        local: by host and flow: the other process runs on the host.
        link: by host and flow: bytes a second that the link can carry; NaN: not known.
        load: by host and flow: bytes a second of others on the link; None: no load.
        round_trip: by host and flow, seconds; NaN or None: not measured.
        limit: fraction of each link that flows may use.
    """
    is_local = np.array(local, np.bool_).reshape(len(local), len(rates))
    rate = np.array(list(rates.values()), np.float64)
    carries = np.where(is_local, np.inf, np.reshape(link, is_local.shape))
    used = np.zeros(is_local.shape) if load is None else np.reshape(load, is_local.shape)
    trip = np.full(is_local.shape, np.nan) if round_trip is None else np.array(round_trip)
    return FlowView(
        processes=tuple(rates),
        hosts=tuple(f"host of {name}" for name in rates),
        rate=rate,
        incoming=np.ones(len(rates), np.bool_),
        is_local=is_local,
        link_rate=carries,
        link_limit=carries * limit,
        link_load=np.where(is_local, 0.0, used),
        added=np.where(is_local, 0.0, rate),
        round_trip=np.where(is_local, 0.0, trip.reshape(is_local.shape)),
    )


#: Specs that a policy must be able to score, given by their differing fields.
_SPECS: Final[Sequence[Mapping[str, Any]]] = (
    {"needs": {"memory": 0.05, "cpu": 0.1}},
    {
        "name": "camera_0", "namespace": "/robot", "priority": 5, "kind": Kind.JOB,
        "environment": {"GROUP": "camera"}, "arguments": ("-v",), "parameters": {"rate": 10.0},
        "required_labels": {"rack": "1"}, "ros": True,
        "migration": MigrationPolicy("relaunch", options={"settle": "2s"}),
    },
    {"name": "9.lives-", "command": (), "module": "pkg.main", "needs": {"gpu": 1.0}},
    {"command": (), "package": "demo", "executable": "talker", "devices": (DeviceNeed("gpu"),)},
)  # fmt: skip


def placements(reads: Sequence[str]) -> Sequence[tuple[HostView, ProcessView]]:
    """Return hosts and processes of many kinds, the same in every run.

    `reads`: fields of the spec that the offer declares; the specs have no others.
    """
    chance = np.random.default_rng(7)
    cases = []
    for count in (1, 2, 7, 100, 1000):
        usage = {name: chance.random(count) * 1.2 for name in ("memory", "cpu", "disk", "gpu")}
        usage["gpu"][chance.random(count) < 0.5] = np.nan
        hosts = host_view(
            {name: list(column) for name, column in usage.items()},
            limit=0.9,
            processes=[n % 3 for n in range(count)],
            labels=[{"rack": str(n % 3)} if n % 4 else {} for n in range(count)],
            tenants=[[f"q{n}_{k}" for k in range(n % 3)] for n in range(count)],
            devices=[{"gpu": n / 2} if n % 3 else {} for n in range(count)],
        )
        cases += [(hosts, process_view(hosts, reads=tuple(reads), **spec)) for spec in _SPECS]
    for resource in ("memory", "something"):
        bare = host_view({resource: [0.2, 0.4]})
        cases.append((bare, process_view(bare, reads=tuple(reads))))
    if FLOWS_FIELD in reads:
        cases += [_with_flows(chance, reads, *one) for one in ((1, 1), (7, 3), (1000, 12))]
    return cases


def _with_flows(
    chance: np.random.Generator, reads: Sequence[str], hosts: int, flows: int
) -> tuple[HostView, ProcessView]:
    """Return hosts and a process with flows, of which some values were not measured."""
    shape = (hosts, flows)
    view = flow_view(
        {f"p{flow}": 10.0 ** float(chance.integers(0, 9)) for flow in range(flows)},
        local=(chance.random(shape) < 0.2).tolist(),
        link=np.where(chance.random(shape) < 0.3, np.nan, 1e7 * chance.random(shape)).tolist(),
        load=(1e7 * chance.random(shape)).tolist(),
        round_trip=np.where(chance.random(shape) < 0.3, np.nan, chance.random(shape)).tolist(),
        limit=0.8,
    )
    at = host_view({"memory": chance.random(hosts).tolist()})
    return at, process_view(at, flows=view, reads=tuple(reads))


class ScoringContract:
    """Contract of a scoring policy with the master.

    Attributes:
        offer: the tested offer.
        options: by name, as in cluster.yaml; the others have their defaults.
    """

    offer: ClassVar[ScoringOffer]
    options: ClassVar[Mapping[str, Any]] = EMPTY

    def make(self) -> ScoringPolicy:
        """Return a new policy; override this if the policy needs more."""
        policy: ScoringPolicy = made("scoring", self.offer, self.options)
        return policy

    def _scores(self, policy: ScoringPolicy, hosts: HostView, process: ProcessView) -> Scores:
        """Return scores, with the time limit and checks of the master."""

        def ask() -> Scores:
            scores = policy.score(hosts, process)
            checked_scores(scores, hosts, np.ones(len(hosts.names), np.bool_))
            return scores

        return call("score", CALL_LIMIT, ask, policy)

    def cases(self) -> Sequence[tuple[HostView, ProcessView]]:
        """Return hosts and processes of many kinds, as passed by the master."""
        return placements(self.offer.reads)

    def test_scores_every_host(self) -> None:
        """The policy returns one number for each host, finite without a veto and never NaN."""
        for hosts, process in self.cases():
            scores = self._scores(self.make(), hosts, process)
            rows = np.flatnonzero(np.isnan(scores.value))
            assert not len(rows), f"the score of the vetoed host {hosts.names[rows[0]]} is NaN"

    def test_rows_are_independent(self) -> None:
        """The score of a host alone is bit-identical to its score among other hosts."""
        policy = self.make()
        for hosts, process in self.cases():
            scores = self._scores(policy, hosts, process)
            together = list(zip(scores.value, vetoes(scores, len(hosts.names)), strict=True))
            for row in range(0, len(hosts.names), 1 + len(hosts.names) // 50):
                scores = self._scores(policy, *one_row(hosts, process, row))
                alone = (scores.value[0], vetoes(scores, 1)[0])
                assert alone == together[row] or np.isnan(alone[0]), (
                    f"among {len(hosts.names)} hosts, {hosts.names[row]} has the score and veto "
                    f"{together[row]}, and alone {alone}: it depends on the other hosts"
                )

    def test_is_pure(self) -> None:
        """The policy returns the same scores for the same arguments, and does not change them."""
        policy, twin = self.make(), self.make()
        for hosts, process in self.cases():
            with unchanged(hosts, process):
                first = self._scores(policy, hosts, process)
                kept = np.array(first.value)
                self._scores(policy, *one_row(hosts, process, len(hosts.names) - 1))
                assert _same(first.value, kept), "an answer changed after it was given"
                for one, whose in ((policy, "the same object"), (twin, "another object")):
                    again = self._scores(one, hosts, process).value
                    assert _same(again, kept), f"{whose} gave other scores for the same arguments"

    def test_gives_reasons(self) -> None:
        """The policy gives a text for every score and a reason for every veto."""
        for hosts, process in self.cases():
            scores = self._scores(self.make(), hosts, process)
            vetoed = vetoes(scores, len(hosts.names))
            for row in range(min(20, len(hosts.names))):
                reason = self._reason(scores, row, "veto_reason" if vetoed[row] else "reason")
                assert reason or not vetoed[row], f"the veto of {hosts.names[row]} has no reason"

    def _reason(self, scores: Scores, row: int, hook: str) -> str:
        ask = partial(getattr(scores, hook), row)
        return call(hook, CALL_LIMIT, lambda: required(ask(), str), scores)

    def test_no_hosts(self) -> None:
        """The policy accepts an empty list of hosts."""
        hosts = host_view({"memory": [], "cpu": []})
        process = process_view(hosts, reads=tuple(self.offer.reads))
        self._scores(self.make(), hosts, process)


@contextmanager
def unchanged(hosts: HostView, process: ProcessView) -> Iterator[None]:
    """Return a context in which the arrays of both views must not change."""
    arrays = (hosts.usage, hosts.limit, hosts.capacity, hosts.processes, process.need)
    before = [array.copy() for array in arrays]
    yield
    for array, copy in zip(arrays, before, strict=True):
        assert _same(array, copy), "an argument was changed"


def _same(array: npt.ArrayLike, other: npt.ArrayLike) -> bool:
    return np.array_equal(array, other, equal_nan=True)


def vetoes(scores: Scores, count: int) -> BoolArray:
    """Return (N,): the vetoes of the scores of `count` hosts; all False without vetoes."""
    return np.zeros(count, np.bool_) if scores.veto is None else np.asarray(scores.veto)


def one_row(hosts: HostView, process: ProcessView, row: int) -> tuple[HostView, ProcessView]:
    """Return the arguments of `score` for one host alone."""
    one = slice(row, row + 1)
    parts = {
        name: getattr(hosts, name)[one]
        for name in (
            "names",
            "usage",
            "limit",
            "capacity",
            "processes",
            "labels",
            "tenants",
            "devices",
        )
    }
    flows = process.flows
    if len(flows.rate):
        names = ("is_local", "link_rate", "link_limit", "link_load", "added", "round_trip")
        flows = replace(flows, **{name: getattr(flows, name)[one] for name in names})
    return replace(hosts, **parts), replace(process, need=process.need[one], flows=flows)
