"""The master's whole decision in the core: filter, score, veto, pick, account.

Two figures, both through `rosrm.core.master.reducer.step` with the policy `weighted`, as in the
master's runtime, without the transport and the journal:

- `us_per_host`: one process is submitted right after fresh readings of all hosts, so that every
  host is evaluated again: microseconds from SubmissionReceived to the commands, per host. The
  paper's master took 84 us per slave for its whole cycle. `readings_us_per_host`: the cost of these
  readings. `over_floor`: the time of the decision over that of a floor (`floor_us`), by turns in
  one run: one numpy pass over the same arrays, with the needs as shares of each capacity, the test
  of the limits, the weighted sum and one argmin; nothing is checked, recorded or accounted.
  `search_over_floor`: the same for the part of the decision that does what the floor does, from the
  demand to the best host; the rest is the submission, its records and its reservation.
- `assignments_per_s`: many processes are submitted at once; from SubmissionReceived to the
  commands, with the queue, the record and the intent of each. `assignments_per_s` is for equal
  processes, `mixed_assignments_per_s` for ten different demands by turns (such as the pieces of a
  map), where each assignment makes the scores of the other demands stale. `rate_of_floor`:
  `assignments_per_s` as a share of what the floor alone would allow. Garbage is collected at the
  thresholds of a master.
- `constrained`: 1,000 processes submitted at once to 1,000 hosts. `plain`: ten different demands by
  turns; `applications`: the same demands with labels and neighbours, in applications of ten
  processes that belong together; `spread`: the same demands, in groups of 150 processes that keep
  apart; `devices`: the same demands, half of them with a camera or a share of a GPU; `links`:
  `applications` with a flow from each member to its driver, on hosts with measured links;
  `network`: the same with the policy `network` in the chain. Assignments a second, and how many
  times as long as `plain` each takes.
"""

from __future__ import annotations

import gc
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from statistics import median
from typing import NamedTuple

import numpy as np

from benchmarks.machine import parser, print_report, say
from benchmarks.stopping import run
from rosrm.core.master import events as happened
from rosrm.core.master.assignment.demands import ranking_of
from rosrm.core.master.commands import Assign
from rosrm.core.master.master_state import MasterState
from rosrm.core.master.reducer import step
from rosrm.core.master.settings import CoreSettings
from rosrm.core.master.state.demand import Demand
from rosrm.extensions.placement import PlacementPlugins, ScoringLink
from rosrm.model.devices import Device, DeviceNeed
from rosrm.model.links import Interface
from rosrm.model.values import (
    RESOURCE_SLOTS,
    HostDescription,
    NeighbourRule,
    ProcessSpec,
    ResourceDescription,
)
from rosrm.runtime.bootstrap import end_start
from rosrm_scoring.network import Network, NetworkOptions
from rosrm_scoring.weighted import DEFAULT_WEIGHTS, Weighted, WeightedOptions

_HOSTS = (10, 100, 1_000, 10_000)
_RESOURCES = ("memory", "cpu", "disk")
_LIMIT = 0.8
#: Seconds since the hosts registered; in the first one, placement may wait for their requests.
_LONG_AGO = 10.0
_AT_ONCE = 5_000
_CONSTRAINED = 1_000
_RACKS = 50
_APPLICATION = 10
_GROUP = 150
_DEMANDS = 10
_DEVICES = (Device("camera", "front", "/dev/video0"), Device("gpu", "0"), Device("gpu", "1"))

#: Returns the spec of a process by its number.
SpecOf = Callable[[int], ProcessSpec]


class Bench:
    """A master's core with hosts that have room.

    Args:
        hosts: how many.
        links: True: the links of all hosts are measured.
        network: True: the policy `network` is in the chain.
    """

    def __init__(self, hosts: int, *, links: bool = False, network: bool = False) -> None:
        self.now = 0.0
        self._sequence = 0
        self._hosts = hosts
        self._random = np.random.default_rng(hosts)
        policy = ScoringLink("weighted", Weighted(WeightedOptions()))
        further = ScoringLink("network", Network(NetworkOptions()), 0.5, ("talks_to",))
        placement = PlacementPlugins((policy, further) if network else (policy,))
        self.state = MasterState(CoreSettings(max_hosts=hosts), placement, {}, epoch=1)
        described = tuple(
            ResourceDescription(name, unit, capacity)
            for name, unit, capacity in (
                ("memory", "B", 2.0**40), ("cpu", "core", 4096.0), ("disk", "B", 2.0**44),
            )
        )  # fmt: skip
        for number in range(hosts):
            labels = {"rack": f"r{number % _RACKS}", "arch": "arm64" if number % 4 else "x86_64"}
            description = HostDescription(
                f"h{number}", number + 1, labels=labels, resources=described, devices=_DEVICES
            )
            self.step(happened.HostRegistered(number, description))
        for number in range(hosts) if links else ():
            peers = {(number + step) % hosts: (0, 0.001) for step in range(1, _RACKS)}
            self.state.hosts.links.store(number, [Interface(125e6)], 0.9, peers)
        self.read()
        for number in range(hosts):
            self.step(happened.ProcessRequested(number, number + 1, number + 1))
        self.now += _LONG_AGO

    def step(self, event: happened.Event) -> tuple[float, int]:
        """Process an event; return the seconds that it took, and the number of assignments."""
        self.now += 0.001
        began = time.perf_counter()
        commands = step(self.state, event, self.now)
        took = time.perf_counter() - began
        return took, sum(isinstance(command, Assign) for command in commands)

    def read(self) -> float:
        """Process fresh readings of all hosts; return the seconds that it took."""
        self._sequence += 1
        n = self._hosts
        usage, limit = np.zeros((n, RESOURCE_SLOTS)), np.ones((n, RESOURCE_SLOTS))
        usage[:, : len(_RESOURCES)] = self._random.uniform(0.1, 0.5, (n, len(_RESOURCES)))
        limit[:, : len(_RESOURCES)] = _LIMIT
        ids = np.arange(1, n + 1)
        readings = happened.ReadingsReceived(
            host_id=ids, incarnation=ids.astype(np.uint64),
            sequence=np.full(n, self._sequence, np.uint64),
            status_sequence=np.zeros(n, np.uint64), accepting=np.ones(n, np.bool_),
            stale=np.zeros(n, np.uint32), usage=usage, limit=limit,
        )  # fmt: skip
        took, _ = self.step(readings)
        return took

    def floor(self) -> float:
        """Return the seconds of the least that a decision for `equal` computes of all hosts."""
        table, needs = self.state.hosts, equal(0).needs
        amounts = np.array([[needs.get(name, 0.0)] for name in table.resources])
        weights = np.array([DEFAULT_WEIGHTS[name] for name in table.resources])
        began = time.perf_counter()
        fits = np.logical_and.reduce(table.busy + amounts / table.capacity <= table.limit)
        np.where(fits, weights @ table.busy, np.inf).argmin()
        return time.perf_counter() - began

    def search(self) -> float:
        """Return the seconds of the choice of a host for `equal`, without its assignment."""
        spec = equal(0)
        demand = Demand(spec, spec.needs, plugins=self.state.placement)
        began = time.perf_counter()
        found = ranking_of(self.state, demand).best()
        took = time.perf_counter() - began
        assert found >= 0
        return took

    def submit(self, specs: Sequence[ProcessSpec]) -> tuple[float, int]:
        """Submit processes at once; return as `step`."""
        return self.step(happened.SubmissionReceived(1, tuple(specs)))


class Timed(NamedTuple):
    """Median microseconds of a decision, its readings and the floor; median ratios to the floor."""

    decision: float
    readings: float
    floor: float
    over_floor: float
    search_over_floor: float


def decision(hosts: int, runs: int) -> Timed:
    """Time single decisions after fresh readings, by turns with the floor."""
    bench = Bench(hosts)
    decisions, readings, floors, searches = [], [], [], []
    for number in range(runs):
        bench.read()
        bench.floor()  # as before the decision, so that both find the arrays in the same caches
        searches.append(bench.search())
        readings.append(bench.read())
        floors.append(bench.floor())
        seconds, assigned = bench.submit([equal(number)])
        assert assigned == 1
        decisions.append(seconds)
    over, search_over = (
        median(one / floor for one, floor in zip(times, floors, strict=True))
        for times in (decisions, searches)
    )
    took, read, floor = (1e6 * median(one) for one in (decisions, readings, floors))
    return Timed(took, read, floor, over, search_over)


def rate(hosts: int, runs: int, spec_of: SpecOf, count: int = _AT_ONCE) -> float:
    """Return the median assignments a second of many processes submitted at once."""
    return median(rate_once(hosts, spec_of, count) for _ in range(runs))


def rate_once(hosts: int, spec_of: SpecOf, count: int, **bench_options: bool) -> float:
    bench = Bench(hosts, **bench_options)
    bench.submit([ProcessSpec("first", needs={"memory": 2.0**26})])
    gc.unfreeze()
    gc.collect()  # the state of the former run
    end_start()  # the thresholds of a master
    took, assigned = bench.submit([spec_of(number) for number in range(count)])
    assert assigned == count
    return assigned / took


def constrained(runs: int) -> dict[str, dict[str, float]]:
    """Return the rates with labels, neighbours, devices and links, by turns with the plain one."""
    cases: dict[str, tuple[SpecOf, dict[str, bool]]] = {
        "plain": (mixed, {}), "applications": (of_application, {}), "spread": (spread, {}),
        "devices": (on_device, {}), "links": (with_flow, {"links": True}),
        "network": (with_flow, {"links": True, "network": True}),
    }  # fmt: skip
    rates: dict[str, list[float]] = {name: [] for name in cases}
    for _ in range(runs):
        for name, (spec_of, options) in cases.items():
            rates[name].append(rate_once(_CONSTRAINED, spec_of, _CONSTRAINED, **options))
    plain = median(rates["plain"])
    return {
        name: {"assignments_per_s": round(median(found)), "times": round(plain / median(found), 2)}
        for name, found in rates.items()
    }


def equal(number: int) -> ProcessSpec:
    return _spec(number, {"memory": 2.0**26, "cpu": 0.1})


def mixed(number: int) -> ProcessSpec:
    kind = number % _DEMANDS
    return _spec(number, {"memory": (8 + 8 * kind) * 2.0**20, "cpu": 0.05 * (1 + kind)})


def of_application(number: int) -> ProcessSpec:
    """Return a member of an application.

    A driver needs a processor of a kind; four members run in its rack, two apart from each other,
    and three workers in racks of their own.
    """
    spec, first = mixed(number), number - number % _APPLICATION
    member = number - first
    if member == 0:
        return replace(spec, required_labels={"arch": "x86_64"})
    if member <= 4:
        rule = NeighbourRule("near", (f"p{first}",), by="rack")
    elif member <= 6:
        rule = NeighbourRule("apart", (f"p{first + 11 - member}",))
    else:
        rule = NeighbourRule("apart", group=f"workers {first}", by="rack")
    return replace(spec, neighbours=(rule,))


def with_flow(number: int) -> ProcessSpec:
    """Return a member of an application that exchanges 1 kB/s with its driver."""
    driver = number - number % _APPLICATION
    flow = {} if number == driver else {f"p{driver}": 1e3}
    return replace(of_application(number), talks_to=flow)


def spread(number: int) -> ProcessSpec:
    rule = NeighbourRule("apart", group=f"group {number // _GROUP}")
    return replace(mixed(number), neighbours=(rule,))


def on_device(number: int) -> ProcessSpec:
    spec = mixed(number)
    if number % 2:
        return spec
    need = DeviceNeed("camera") if number % 4 else DeviceNeed("gpu", 0.25)
    return replace(spec, devices=(need,))


def _spec(number: int, needs: dict[str, float]) -> ProcessSpec:
    return ProcessSpec(f"p{number}", package="maps", executable="map_piece", needs=needs)


def main() -> None:
    command_line = parser(__doc__)
    command_line.add_argument("--runs", type=int, default=7, help="measurements of each figure")
    runs = command_line.parse_args().runs
    per_host, read, rates, mixed_rates = {}, {}, {}, {}
    floor_us, over_floor, search_over_floor, rate_of_floor = {}, {}, {}, {}
    for hosts in _HOSTS:
        us, readings, floor, over, search_over = decision(hosts, 20 * runs)
        per_host[str(hosts)], read[str(hosts)] = round(us / hosts, 4), round(readings / hosts, 4)
        floor_us[str(hosts)], over_floor[str(hosts)] = round(floor, 1), round(over, 2)
        search_over_floor[str(hosts)] = round(search_over, 2)
        say(
            f"{hosts:6} hosts: {us / hosts:.4f} us a host for a decision, {over:.2f} times the "
            f"floor of {floor:.1f} us, its search {search_over:.2f} times; "
            f"{readings / hosts:.4f} us for its readings"
        )
    for hosts in _HOSTS:
        rates[str(hosts)] = round(rate(hosts, runs, equal))
        mixed_rates[str(hosts)] = round(rate(hosts, runs, mixed))
        rate_of_floor[str(hosts)] = round(rates[str(hosts)] * floor_us[str(hosts)] / 1e6, 2)
        say(f"{hosts:6} hosts: {rates[str(hosts)]} equal, {mixed_rates[str(hosts)]} mixed a second")
    with_rules = constrained(runs)
    for name, figure in with_rules.items():
        say(f"{name:12}: {figure['assignments_per_s']} a second, {figure['times']} times as long")
    figures = {
        "us_per_host": per_host, "floor_us": floor_us, "over_floor": over_floor,
        "search_over_floor": search_over_floor,
        "assignments_per_s": rates, "rate_of_floor": rate_of_floor,
        "mixed_assignments_per_s": mixed_rates, "readings_us_per_host": read,
        "constrained": with_rules,
    }  # fmt: skip
    print_report("decide", figures, runs=runs)


if __name__ == "__main__":
    sys.exit(run("decide", main))
