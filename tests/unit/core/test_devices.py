"""Devices: given to one process, or shared, and held until the instance is gone."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from rosrm.core.master import listing
from rosrm.core.slave import commands, events, reducer
from rosrm.core.slave.state import SlaveState
from rosrm.core.slave.watches import Memo
from rosrm.extensions.contracts import HostView, ProcessView, Scores
from rosrm.model.devices import Device, DeviceNeed, HeldDevice
from rosrm.model.values import (
    HostLossPolicy,
    InstanceId,
    InstanceState,
    InstanceStatus,
    MigrationPolicy,
    NeighbourRule,
    ProcessSpec,
    RestartPolicy,
    StandbyPolicy,
)
from tests.unit.core.cluster import Cluster, Machine, movable, node, process

FRONT = Device("camera", "front", "/dev/video0")
GPUS = (Device("gpu", "0"), Device("gpu", "1"))


def asks(spec: ProcessSpec, *needs: DeviceNeed) -> ProcessSpec:
    return replace(spec, devices=needs or (DeviceNeed("camera"),))


def cam(name: str, **fields: Any) -> ProcessSpec:
    """Return a movable process that asks for one camera."""
    return asks(movable(name, **fields))


def on_gpu(name: str, amount: float) -> ProcessSpec:
    return asks(process(name), DeviceNeed("gpu", amount))


def host(name: str, *devices: Device) -> Machine:
    return Machine(name, devices=devices)


def given(cluster: Cluster) -> dict[str, list[str]]:
    """Return the devices with which each process really runs."""
    return {
        str(instance.process): [str(one) for one in program.assignment.devices]
        for machine in cluster.machines.values()
        for instance, program in machine.programs.items()
    }


def free(cluster: Cluster, name: str) -> dict[str, float]:
    """Return the free share of each device of a host."""
    rows = {row.description.name: row for row in listing.host_rows(cluster.state, cluster.now)}
    return {one.title: one.free for one in rows[name].devices}


def why(cluster: Cluster, name: str, on: str = "a") -> str:
    """Return the reason against a host."""
    hosts = cluster.explain(name)["decision"]["hosts"]
    return next(one["reason"] for one in hosts if one["name"] == on)


def set_devices(cluster: Cluster, name: str, *devices: Device) -> None:
    """Change the devices of a host, which its slave reports."""
    cluster.machines[name].devices = devices
    cluster.report(name)
    cluster.wait(0.3)


def restart_slave(cluster: Cluster, name: str) -> None:
    """Restart a slave that has been silent for long enough to be replaced."""
    cluster.cut(name, seconds=3.0)
    assert cluster.restart_slave(name).accepted


# --- one process for each unit ------------------------------------------------------------------


def test_a_device_is_given_to_one_process_until_it_is_gone() -> None:
    """A second process waits, with the holder as the reason, and gets the device afterwards."""
    cluster = Cluster(host("a", FRONT)).with_processes(cam("p"), cam("q"))
    assert given(cluster) == {"p": ["camera front"]}
    assert free(cluster, "a") == {"camera front": 0.0}
    assert why(cluster, "q") == "camera: needs 1; camera front is held by p#1"
    cluster.cancel("p")
    assert given(cluster) == {"q": ["camera front"]}


def test_the_queue_says_which_device_it_waits_for() -> None:
    """The first row names the holder of the device, the next ones the first process."""
    cluster = Cluster(host("a", FRONT), host("b"))
    cluster.with_processes(cam("p"), cam("q"), process("r"))
    rows = {row.name: row.reason for row in listing.process_rows(cluster.state, cluster.now)}
    assert rows["q"] == ("no host can take it now: a: camera: needs 1; camera front is held by p#1")
    assert rows["r"] == "waits behind q"


def test_the_record_of_an_assignment_names_the_devices() -> None:
    """Users find the devices of a process in `rosrm events`."""
    cluster = Cluster(host("a", FRONT)).with_processes(cam("p"))
    assert "p is assigned to a with camera front" in cluster.recorded("assigned")


def test_a_named_unit_is_the_only_one_that_fits() -> None:
    """Other units of the kind do not count, and the reason lists them."""
    rear = DeviceNeed("camera", 1.0, ("rear",))
    cluster = Cluster(host("a", FRONT), host("b", FRONT, Device("camera", "rear", "/dev/video1")))
    cluster.with_processes(asks(process("p"), rear))
    assert (cluster.where("p"), given(cluster)) == (["b"], {"p": ["camera rear"]})
    assert why(cluster, "p") == "it has no camera rear (there: front)"


def test_several_units_and_kinds_are_given_together_or_not_at_all() -> None:
    """A process gets all its devices on one host."""
    both = (DeviceNeed("gpu", 2.0), DeviceNeed("camera"))
    cluster = Cluster(host("a", *GPUS), host("b", FRONT, GPUS[0]), host("c", FRONT, *GPUS))
    cluster.with_processes(asks(process("p"), *both))
    assert given(cluster) == {"p": ["gpu 0", "gpu 1", "camera front"]}
    assert why(cluster, "p", "a") == "it has no camera"
    assert why(cluster, "p", "b") == "gpu: needs 2; it has 1"


def test_a_shareable_device_is_given_to_as_many_processes_as_it_allows() -> None:
    """The next process waits."""
    cluster = Cluster(host("a", Device("lidar", "lidar", shareable=2)))
    cluster.with_processes(*(asks(process(name), DeviceNeed("lidar")) for name in "pqr"))
    assert sorted(given(cluster)) == ["p", "q"]
    assert why(cluster, "r") == "lidar: needs 1; lidar is held by p#1 and q#2"


def test_shares_fill_one_unit_before_the_next() -> None:
    """So whole units stay free for processes that need them."""
    cluster = Cluster(host("a", *GPUS))
    cluster.with_processes(on_gpu("p", 0.5), on_gpu("q", 0.25), on_gpu("r", 0.25), on_gpu("s", 1.0))
    assert {name: one[0][-1] for name, one in given(cluster).items()} == {
        "p": "0", "q": "0", "r": "0", "s": "1",
    }  # fmt: skip
    assert free(cluster, "a") == pytest.approx({"gpu 0": 0.0, "gpu 1": 0.0})


def test_a_share_does_not_fit_where_less_is_left() -> None:
    """Three shares of 0.4 need two units."""
    cluster = Cluster(host("a", *GPUS))
    cluster.with_processes(*(on_gpu(name, 0.4) for name in "pqrst"))
    assert sorted(given(cluster)) == ["p", "q", "r", "s"]


# --- hosts without the device --------------------------------------------------------------------


def test_a_process_whose_device_no_host_has_does_not_block_the_queue() -> None:
    """The process is set aside, with the known kinds, and queued when a host brings the device."""
    cluster = Cluster(host("a", FRONT))
    cluster.with_processes(asks(process("p"), DeviceNeed("camra")), process("q"))
    assert (cluster.phase("p"), cluster.phase("q")) == ("set_aside", "running")
    assert cluster["p"].reason == (
        "no host may take it: no host has a 'camra' among its devices; did you mean 'camera'? "
        "(there: camera)"
    )
    cluster.add(host("b", Device("camra", "x")))
    cluster.wait(0.5)
    assert cluster.where("p") == ["b"]


def test_more_units_than_any_host_has_are_set_aside() -> None:
    """The reason is that against an empty host, also while the units are held."""
    cluster = Cluster(host("a", *GPUS)).with_processes(on_gpu("p", 1.0), on_gpu("q", 3.0))
    assert cluster.phase("q") == "set_aside"
    assert "gpu: needs 3; it has 2" in cluster["q"].reason


def test_a_missing_device_is_not_given_and_one_that_returns_is() -> None:
    """Until then the process is set aside, and does not block the queue."""
    cluster = Cluster(host("a", replace(FRONT, missing="/dev/video0: gone")))
    cluster.with_processes(cam("p"), process("q"))
    assert (cluster.phase("p"), cluster.phase("q")) == ("set_aside", "running")
    assert "camera front is missing: /dev/video0: gone" in cluster["p"].reason
    set_devices(cluster, "a", FRONT)
    assert given(cluster)["p"] == ["camera front"]
    assert cluster.recorded("device_found") == ["camera front on a is there again"]


def test_a_device_that_goes_missing_stays_held() -> None:
    """The record names the holder; when the device returns, no other process gets it."""
    cluster = Cluster(host("a", FRONT)).with_processes(cam("p"), cam("q"))
    set_devices(cluster, "a", replace(FRONT, missing="gone"))
    assert cluster.recorded("device_missing") == [
        "camera front on a is missing: gone; p#1 holds it"
    ]
    assert free(cluster, "a") == {"camera front": 0.0}
    set_devices(cluster, "a", FRONT)
    assert cluster.where("q") == []


# --- restarts, moves, standbys -------------------------------------------------------------------


def test_a_device_is_held_through_restarts() -> None:
    """The restart policy starts the same instance again."""
    cluster = Cluster(host("a", FRONT))
    cluster.with_processes(cam("p", restart=RestartPolicy("always")), cam("q"))
    cluster.finish("p", code=1)
    assert given(cluster) == {"p": ["camera front"]}


def test_a_move_holds_devices_at_both_ends() -> None:
    """Until the source is gone, no other process gets its device."""
    cluster = Cluster(host("a", FRONT), host("b", Device("camera", "top")))
    cluster.with_processes(cam("p"), cam("q"))
    cluster.cancel("q")
    cluster.machines["a"].stubborn.add("p")
    assert cluster.migrate("p").accepted
    cluster.wait(1.0)
    assert (free(cluster, "a"), free(cluster, "b")) == ({"camera front": 0.0}, {"camera top": 0.0})
    cluster.let_go("p")
    cluster.wait(1.0)
    assert (free(cluster, "a"), free(cluster, "b")) == ({"camera front": 1.0}, {"camera top": 0.0})
    assert given(cluster) == {"p": ["camera top"]}


@pytest.mark.parametrize("restarted", [False, True], ids=["same master", "restarted master"])
def test_the_source_gets_its_device_back_if_the_move_fails(restarted: bool) -> None:
    """A process that waits for the device does not get it while the source is stopped."""
    cluster = Cluster(host("a", FRONT), host("b", Device("camera", "top")))
    cluster.with_processes(cam("p", overlap=False))
    cluster.machines["b"].refuses["p"] = "no such program"
    cluster.machines["b"].connected = not restarted
    assert cluster.migrate("p", "b").accepted
    if restarted:
        cluster.wait(0.3)
        assert cluster.where("p") == []
        cluster.restart_master()
    cluster.submit(asks(process("q"), DeviceNeed("camera", 1.0, ("front",))))
    cluster.rejoin("b", seconds=15.0)
    assert (cluster.where("p"), cluster.where("q")) == (["a"], [])
    assert given(cluster) == {"p": ["camera front"]}


def test_a_standby_holds_devices_of_its_own_host() -> None:
    """No other process gets the unit of a standby."""
    spec = node("p", migration=MigrationPolicy("handoff"), standby=StandbyPolicy(wanted=True))
    cluster = Cluster(host("a", FRONT), host("b"), host("c", FRONT))
    cluster.with_processes(asks(spec))
    cluster.discover("p")
    cluster.wait(1.0)
    assert free(cluster, "c") == {"camera front": 0.0}


def test_processes_that_run_together_get_different_units() -> None:
    """A host with one camera does not take two processes that must run near each other."""
    near = (NeighbourRule("near", ("p",)),)
    cluster = Cluster(host("a", FRONT), host("b", FRONT, Device("camera", "top")))
    cluster.with_processes(cam("p"), cam("q", neighbours=near))
    assert (cluster.where("p"), cluster.where("q")) == (["b"], ["b"])


# --- restarts of the master and of slaves, lost hosts --------------------------------------------


def test_a_restarted_master_knows_which_instances_hold_devices() -> None:
    """Also before any slave has reported."""
    cluster = Cluster(host("a", FRONT)).with_processes(cam("p"))
    cluster.kill_master()
    assert free(cluster, "a") == {}
    assert str(cluster.state.hosts.devices[0].held) == str(
        {InstanceId("p", 1): (HeldDevice("camera", "front"),)}
    )
    cluster.restart_master()
    cluster.with_processes(cam("q"))
    assert given(cluster) == {"p": ["camera front"]}


def test_a_master_without_its_journal_learns_the_holders_from_the_slaves() -> None:
    """The device of an instance that it stops stays held until the instance has ended."""
    cluster = Cluster(host("a", FRONT)).with_processes(cam("p"))
    cluster.machines["a"].stubborn.add("p")
    cluster.intents["process"].clear()
    cluster.restart_master()
    cluster.with_processes(cam("q"))
    assert cluster.where("q") == []
    cluster.let_go("p")
    cluster.wait(0.5)
    assert given(cluster) == {"q": ["camera front"]}


def test_a_restarted_slave_still_reports_the_devices_of_its_instances() -> None:
    """Its supervisor has stored them."""
    cluster = Cluster(host("a", FRONT)).with_processes(cam("p"), cam("q"))
    restart_slave(cluster, "a")
    cluster.wait(0.5)
    assert given(cluster) == {"p": ["camera front"]}
    assert free(cluster, "a") == {"camera front": 0.0}


def test_the_device_of_a_lost_host_is_held_by_what_still_runs_there() -> None:
    """An instance with a successor elsewhere is killed before its device is given again."""
    lost = HostLossPolicy("elsewhere")
    cluster = Cluster(host("a", FRONT), host("b", FRONT), lease=5.0)
    cluster.with_processes(cam("p", host_loss=lost))
    cluster.machines["a"].stubborn.add("p")
    cluster.cut("a", seconds=8.0)
    assert cluster.where("p") == ["a", "b"]
    cluster.submit(asks(process("q")))
    cluster.rejoin("a")
    assert given(cluster)["q"] == ["camera front"]
    assert cluster.where("p") == ["b"]


def test_slaves_with_other_devices_after_a_restart() -> None:
    """A process keeps what it holds; a unit that is no longer offered is given to no other."""
    cluster = Cluster(host("a", FRONT)).with_processes(cam("p"), cam("q"))
    cluster.machines["a"].devices = (Device("camera", "rear"),)
    restart_slave(cluster, "a")
    cluster.wait(0.5)
    assert given(cluster) == {"p": ["camera front"], "q": ["camera rear"]}


# --- plugins and listings ------------------------------------------------------------------------


class FewestGpus:
    """Prefers the host with the fewest free GPUs, so that others stay free."""

    def score(self, hosts: HostView, process: ProcessView) -> Scores:
        assert len(hosts.devices) == len(hosts.names)
        return Scores(np.array([one.get("gpu", 9.0) for one in hosts.devices]))


def test_a_scoring_policy_sees_the_free_units() -> None:
    """Also while equal processes are placed one after the other, which are scored ahead."""
    hosts = (host("a", *GPUS, Device("gpu", "2")), host("b", *GPUS), host("c", FRONT))
    cluster = Cluster(*hosts, policy=FewestGpus())
    cluster.with_processes(*(on_gpu(f"p{number}", 0.5) for number in range(11)))
    assert [cluster.where(f"p{number}") for number in range(10)] == [["b"]] * 4 + [["a"]] * 6
    assert cluster.where("p10") == []


def test_the_view_of_devices_cannot_be_changed() -> None:
    """A policy that writes into it would change what others see."""
    failures: list[Exception] = []

    class Writer:
        def score(self, hosts: HostView, process: ProcessView) -> Scores:
            assert process.spec.devices == (DeviceNeed("camera"),)
            with pytest.raises(TypeError) as refused:
                hosts.devices[0]["camera"] = 9.0  # type: ignore[index]
            failures.append(refused.value)
            return Scores(np.zeros(len(hosts.names)))

    cluster = Cluster(host("a", FRONT), policy=Writer()).with_processes(cam("p"))
    assert cluster.where("p") == ["a"]
    assert failures


# --- the slave's core ----------------------------------------------------------------------------


@pytest.mark.parametrize("missing", [True, False])
def test_a_run_that_holds_a_missing_device_has_failed(missing: bool) -> None:
    """Its restart policy decides what follows; processes with other devices run on."""
    slave, instance = SlaveState(), InstanceId("p", 1)
    ready = InstanceStatus(instance, InstanceState.RUNNING, pid=7)
    memos = {instance: Memo(devices=(HeldDevice("camera", "front"),))}
    reducer.step(slave, events.SupervisorReplaced((ready,), memos), 1.0)
    lost = {("camera", "front" if missing else "rear"): "gone"}
    expected = [commands.Fail(instance, 7, "unhealthy: camera front is missing: gone", kill=False)]
    found = reducer.step(slave, events.DevicesMissed(lost), 2.0)
    assert list(found) == (expected if missing else [])
