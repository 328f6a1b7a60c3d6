"""Periodic checkpoints in the core: eligible processes, pace, failures and removal."""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Mapping
from dataclasses import replace
from decimal import Decimal
from typing import Any

import pytest

from rosrm.core.master.commands import SendOrder
from rosrm.extensions.contracts import CheckpointChoice, CheckpointView, MemoryView
from rosrm.model.orders import RunExecutor
from rosrm.model.plan import Execute
from rosrm.model.values import MigrationPolicy, ProcessSpec, Readiness, RestartPolicy
from rosrm_criu.options import CriuOptions
from rosrm_criu.strategy import Criu
from tests.criu_kit import HOST_FACTS
from tests.unit.core.cluster import Cluster, process
from tests.unit.core.machine import Machine


class Pacing:
    """Checkpoint policy that returns a set answer and records its questions."""

    def __init__(self) -> None:
        self.answer: Any = None
        self.views: list[MemoryView] = []

    def choose(self, process: CheckpointView) -> CheckpointChoice | None:
        return None

    def pace(self, process: MemoryView) -> float | None:
        self.views.append(process)
        if isinstance(self.answer, Exception):
            raise self.answer
        return process.asked if self.answer is None else self.answer


class Host:
    """Simulated host on which CRIU works; records its executor calls."""

    def __init__(self, name: str = "a") -> None:
        self.dumps: list[Mapping[str, Any]] = []
        self.sweeps = 0
        self.answer: Any = {"size": 5000, "seconds": {"prepare": 0.1, "dump": 0.2, "join": 0.3}}
        executors = {
            "criu_host_check": lambda _: {**HOST_FACTS, "host": name, "no_transfer": ""},
            "criu_dump": self._dump, "criu_sweep": self._sweep,
        }  # fmt: skip
        self.machine = Machine(name, executors=executors)

    def _dump(self, arguments: Mapping[str, Any]) -> Any:
        self.dumps.append(arguments)
        if isinstance(self.answer, Exception):
            raise self.answer
        return self.answer

    def _sweep(self, arguments: Mapping[str, Any]) -> Any:
        self.sweeps += 1
        return {}


def portable(every: Any = 10.0, **fields: Any) -> ProcessSpec:
    options = {} if every is None else {"checkpoint_every": every}
    return process(
        "p", ros=True, readiness=Readiness("running"), restart=RestartPolicy("on-failure"),
        migration=MigrationPolicy("criu", options=options), **fields,
    )  # fmt: skip


def cluster_with(policy: Any, machine: Machine, strategy: Any = None) -> Cluster:
    """Return a cluster with this checkpoint policy and strategy `criu`."""
    cluster = Cluster(machine, strategies={"criu": strategy or Criu(CriuOptions())})
    cluster.state.replication.policy, cluster.state.replication.policy_name = policy, "pacing"
    return cluster


def running(policy: Any, host: Host, spec: ProcessSpec | None = None) -> Cluster:
    """Return a cluster with a portable node that has run for a second."""
    cluster = cluster_with(policy, host.machine)
    cluster.submit(spec or portable())
    cluster.wait(1.0)
    assert cluster.phase("p") == "running"
    return cluster


def test_checkpoints_follow_the_pace_of_the_process():
    """The first image follows after one period; each image has its own attempt number."""
    host = Host()
    cluster = running(Pacing(), host)
    cluster.wait(8.0)
    assert host.dumps == []
    cluster.wait(23.0)
    number = cluster["p"].owner
    assert [dump["source"] for dump in host.dumps] in ([number] * 2, [number] * 3)
    assert len({dump["attempt"] for dump in host.dumps}) == len(host.dumps)


def test_the_policy_gets_the_cost_of_the_last_checkpoint():
    """The policy may then choose longer pauses."""
    host, policy = Host(), Pacing()
    cluster = running(policy, host)
    cluster.wait(12.0)
    assert policy.views[0] == MemoryView(cluster["p"].spec, "a", 10.0, 0, 0.0)
    assert policy.views[-1].size == 5000
    assert policy.views[-1].pause == pytest.approx(0.6)
    policy.answer = 1000.0
    made = len(host.dumps)
    cluster.wait(100.0)
    assert len(host.dumps) == made


@pytest.mark.parametrize("spec", [portable(None), portable(0.0)])
def test_a_process_that_does_not_ask_has_no_checkpoint(spec):
    """A periodic checkpoint freezes the process, so only processes that ask for it get one."""
    host = Host()
    cluster = running(Pacing(), host, spec=spec)
    cluster.wait(60.0)
    assert host.dumps == []
    assert cluster.recorded("periodic_failed") == []


def test_the_first_checkpoint_is_recorded_and_explained():
    """Later images are not recorded, because they are many."""
    host = Host()
    cluster = running(Pacing(), host)
    cluster.wait(60.0)
    (said,) = cluster.recorded("periodic_checkpoint")
    assert "5.0 kB, paused for 0.60 s" in said
    told = cluster.explain("p")["checkpoint"]
    assert (told["size"], told["trouble"]) == (5000, "")
    assert 0.0 <= told["elapsed"] <= 11.0


@pytest.mark.parametrize(
    "seconds",
    [
        {"dump": "x" * 900_000},
        {"x" * 900_000: 1.0},
        {str(n): 0.1 for n in range(50_000)},
        ["x"] * 9,
    ],
    ids=["long text", "long name", "many", "list"],
)
def test_an_event_has_the_durations_of_an_executor_within_bounds(seconds):
    """A few events with a megabyte each would make every listing of events too large to send."""
    host = Host()
    host.answer = {"size": 5000, "seconds": seconds}
    cluster = running(Pacing(), host)
    cluster.wait(12.0)
    (event,) = [one for one in cluster.records if one.kind == "periodic_checkpoint"]
    assert len(json.dumps(dict(event.facts))) < 5_000


@pytest.mark.parametrize(
    "number", [float("inf"), float("nan"), pytest.param(10**400, id="huge"), -1, "big"]
)
def test_a_strange_number_in_a_result_counts_as_zero(number):
    """A plugin's executor may answer anything that JSON can hold, and the master continues."""
    host = Host()
    host.answer = {"size": number, "seconds": {"dump": number}}
    cluster = running(Pacing(), host)
    cluster.wait(15.0)
    assert cluster.explain("p")["checkpoint"]["size"] == 0
    assert len(cluster.recorded("periodic_checkpoint")) == 1


def test_a_failed_checkpoint_is_recorded_once_and_retried():
    """The record of the next success follows, too."""
    host = Host()
    host.answer = RuntimeError("no room")
    cluster = running(Pacing(), host)
    cluster.wait(45.0)
    assert len(host.dumps) >= 3
    assert cluster.recorded("periodic_failed") == ["no periodic checkpoint of p was made: no room"]
    assert cluster.explain("p")["checkpoint"]["trouble"] == "no room"
    host.answer = {"size": 1, "seconds": {}}
    cluster.wait(12.0)
    assert len(cluster.recorded("periodic_checkpoint")) == 1
    assert cluster.explain("p")["checkpoint"]["trouble"] == ""


def pacing(answer: Any) -> Pacing:
    policy = Pacing()
    policy.answer = answer
    return policy


@pytest.mark.parametrize(
    ("policy", "reason"),
    [
        (None, "no checkpoint policy is selected"),
        (object(), "'pacing' makes none of memory"),
        *(
            (pacing(answer), "'pacing'")
            for answer in (ValueError("oops"), 0.0, -1.0, float("nan"), float("inf"))
        ),
    ],
)
def test_a_policy_without_a_valid_pace_makes_no_checkpoint(policy, reason):
    """The record names the reason, and the process keeps running."""
    host = Host()
    cluster = running(policy, host)
    cluster.wait(30.0)
    assert host.dumps == []
    (message,) = cluster.recorded("periodic_failed")
    assert reason in message
    assert cluster.phase("p") == "running"


def test_a_pace_of_another_type_of_number_is_read_as_one():
    """The core adds the pace to times, which not every type of number allows."""
    host = Host()
    cluster = running(pacing(Decimal(10)), host)
    cluster.wait(35.0)
    assert len(host.dumps) == 3
    assert not cluster.recorded("plugin_failed")


def test_a_host_without_criu_makes_no_checkpoint():
    """The record names the host's own reason."""
    cluster = cluster_with(Pacing(), Machine("a"))
    cluster.submit(portable())
    cluster.wait(30.0)
    (message,) = cluster.recorded("periodic_failed")
    assert "criu does not work on a" in message


def test_an_unreachable_process_has_no_checkpoint():
    """A checkpoint would disturb a plan, a stop or a process on a host without contact."""
    host = Host()
    cluster = running(Pacing(), host)
    host.machine.connected = False
    cluster.wait(30.0)
    assert host.dumps == []


def test_the_images_of_an_ended_instance_are_removed():
    """Once the instance has ended, its host is ordered to remove its images."""
    host = Host()
    cluster = running(Pacing(), host)
    cluster.wait(12.0)
    before = host.sweeps
    cluster.cancel("p")
    cluster.wait(5.0)
    assert cluster.phase("p") == "cancelled"
    assert host.sweeps == before + 1


def test_a_lost_order_to_remove_images_is_repeated():
    """Without an answer the order is repeated; otherwise the images would stay on the host."""
    host = Host()
    cluster = running(Pacing(), host)
    cluster.wait(12.0)
    before = host.sweeps
    cluster.cancel("p")
    host.machine.ordered = deque(maxlen=0)
    cluster.wait(5.0)
    assert host.sweeps == before
    host.machine.ordered = deque()
    cluster.wait(60.0)
    assert host.sweeps == before + 1
    assert not cluster.state.periodic.of


def test_dumps_that_always_fail_pause_the_process_less_and_less():
    """Each dump freezes the process for a while, so the wait after each failure doubles."""
    host = Host()
    host.answer = RuntimeError("no room")
    cluster = running(Pacing(), host)
    cluster.wait(1200.0, tick=0.5)
    assert 6 <= len(host.dumps) <= 14


class Unsound(Criu):
    """Strategy that proposes a step changed by a test."""

    fields: Mapping[str, Any] = {}

    def periodic(self, *given: Any) -> Execute:
        return replace(super().periodic(*given), **self.fields)


@pytest.mark.parametrize(
    ("fields", "reason"),
    [
        ({"timeout": "10s"}, "timeout: float is required, not '10s'"),
        ({"arguments": {"of": {1}}}, "set is not JSON serializable"),
    ],
)
def test_a_step_with_a_field_of_a_wrong_type_is_not_ordered(fields, reason):
    """The record names the strategy; an order with that field would end the master."""
    host, strategy = Host(), Unsound(CriuOptions())
    strategy.fields = fields
    cluster = cluster_with(Pacing(), host.machine, strategy)
    cluster.submit(portable())
    cluster.wait(15.0)
    assert host.dumps == []
    (message,) = cluster.recorded("periodic_failed")
    assert reason in message


def late(plugin: tuple[str, str], call: Any) -> Any:
    """Stand for a plugin call of a strategy that exceeded its deadline."""
    if plugin[0] == "migration":
        raise TimeoutError("late")
    return call()


def test_a_strategy_that_fails_to_name_its_removal_is_called_again():
    """Otherwise the images of the instance stay on the host."""
    host = Host()
    cluster = cluster_with(Pacing(), host.machine)
    cluster.submit(portable())
    limit, cluster.state.plugins.limit = cluster.state.plugins.limit, late
    cluster.wait(2.0)
    cluster.cancel("p")
    cluster.wait(5.0)
    assert (cluster.phase("p"), host.sweeps) == ("cancelled", 0)
    cluster.state.plugins.limit = limit
    cluster.wait(5.0)
    assert host.sweeps == 1


def test_a_restarted_master_orders_the_next_checkpoint():
    """The new master knows of no image and orders the next one."""
    host = Host()
    cluster = running(Pacing(), host)
    cluster.wait(12.0)
    made = len(host.dumps)
    cluster.restart_master()
    cluster.state.replication.policy = Pacing()
    cluster.wait(30.0)
    assert len(host.dumps) > made
    assert len({dump["attempt"] for dump in host.dumps}) == len(host.dumps)


class Lossy(deque):
    """Queue of orders that loses those for a dump."""

    def append(self, sent: SendOrder) -> None:
        if getattr(sent.order, "executor", "") != "criu_dump":
            super().append(sent)


def test_the_master_does_not_wait_for_a_checkpoint_that_ended_with_its_slave():
    """The next slave receives orders at the same pace, though no answer to the first arrives."""
    host = Host()
    cluster = running(Pacing(), host)
    host.machine.ordered = Lossy()
    cluster.wait(20.0)
    assert (host.dumps, len(cluster.orders(RunExecutor))) == ([], 2)
    host.machine.ordered = deque()
    cluster.cut("a", seconds=1.5)  # otherwise its name is still taken
    cluster.restart_slave("a")
    cluster.wait(15.0)
    assert len(host.dumps) == 1
