"""Components that the slave loads into a container after each start and restart."""

from __future__ import annotations

from pathlib import Path

import pytest

from rosrm.artifacts.cache import set_directory
from rosrm.core.slave.commands import Fail, ListComponents, LoadComponent, Stop
from rosrm.core.slave.components import LIST_PERIOD
from rosrm.core.slave.events import (
    ComponentLoaded,
    ComponentsListed,
    SeenInGraph,
    SupervisorReplaced,
    TimePassed,
)
from rosrm.core.slave.state import HeldInstance
from rosrm.errors import LaunchError
from rosrm.model.artifacts import Artifact
from rosrm.model.devices import Device, HeldDevice
from rosrm.model.values import (
    Component,
    InstanceId,
    InstanceState,
    InstanceStatus,
    ProcessSpec,
    Readiness,
)
from rosrm.slave.launch.components import filled_component
from rosrm.slave.memos import from_memo, to_memo
from tests.unit.slave.rig import Slave, states

C = InstanceId("c", 1)
PID = 5
CAMERA, FILTER = Component("m:Camera", "camera", namespace="/left"), Component("m:Filter", "filter")
SPEC = ProcessSpec(
    "c", module="m", ros=True, namespace="/robot", readiness=Readiness(timeout=10.0),
    components=(CAMERA, FILTER),
)  # fmt: skip
ASKED = [ListComponents(C, PID, "/robot/c/_container")]


def seen() -> Slave:
    """Return a slave whose container has just appeared in the graph."""
    slave = Slave()
    slave.assign(SPEC)
    slave.status(InstanceState.RUNNING, "c")
    assert slave.step(SeenInGraph(C)) == ASKED
    return slave


def listed(slave: Slave, *names: str):
    return slave.step(ComponentsListed(C, PID, frozenset(names)))


def loaded(slave: Slave, component: Component, fault: str = ""):
    return slave.step(ComponentLoaded(C, PID, component, fault))


def load_of(component: Component) -> list[LoadComponent]:
    return [LoadComponent(C, PID, "/robot/c/_container", component)]


def test_a_container_is_ready_when_it_has_all_components() -> None:
    """They are loaded in the order of the spec, one after the other."""
    slave = seen()
    assert listed(slave) == load_of(CAMERA)
    assert loaded(slave, CAMERA) == ASKED
    assert listed(slave, "/left/camera") == load_of(FILTER)
    assert loaded(slave, FILTER) == ASKED
    assert slave.of("c").status.state is InstanceState.RUNNING
    assert states(listed(slave, "/left/camera", "/filter")) == [InstanceState.READY]


def test_components_that_are_there_are_not_loaded_again() -> None:
    """A former run of the slave has loaded them."""
    assert listed(seen(), "/left/camera") == load_of(FILTER)
    assert states(listed(seen(), "/filter", "/left/camera", "/other")) == [InstanceState.READY]


def test_a_component_that_cannot_be_loaded_fails_the_run() -> None:
    """The reason is that of the container, and the restart policy applies."""
    slave = seen()
    listed(slave)
    (failed,) = loaded(slave, CAMERA, "OSError: no camera")
    reason = "not ready: the component /left/camera cannot be loaded: OSError: no camera"
    assert failed == Fail(C, PID, reason, kill=False)


def test_a_list_without_answer_is_requested_again() -> None:
    """Discovery may not have found the services yet; a load in progress is not disturbed."""
    slave = seen()
    assert slave.step(TimePassed(), LIST_PERIOD / 2) == []
    assert slave.step(TimePassed(), LIST_PERIOD) == ASKED
    listed(slave)
    assert slave.step(TimePassed(), LIST_PERIOD) == []


def test_a_component_is_not_loaded_twice_because_the_list_lacks_it() -> None:
    """The container may list it later; until then the slave asks again."""
    slave = seen()
    listed(slave)
    loaded(slave, CAMERA)
    assert listed(slave) == load_of(FILTER)
    loaded(slave, FILTER)
    assert listed(slave, "/filter") == []
    assert slave.step(TimePassed(), LIST_PERIOD) == ASKED


def test_the_readiness_time_out_ends_a_container_and_names_the_component() -> None:
    """A constructor may take long, but not longer."""
    slave = seen()
    listed(slave)
    assert slave.step(TimePassed(), 10.0) == [Stop(C)]
    slave.status(InstanceState.FAILED, "c")
    said = "not ready within 10 s: the component /left/camera was still being loaded"
    assert slave.of("c").status.message == said


def test_a_container_that_is_being_stopped_becomes_ready_no_more() -> None:
    """The answer of the load comes after the time-out."""
    slave = seen()
    listed(slave)
    assert slave.step(TimePassed(), 10.0) == [Stop(C)]
    assert loaded(slave, CAMERA) == []


def test_the_next_run_gets_all_components_again() -> None:
    """Also from a slave that knows the container only by the memo of a former run."""
    slave = seen()
    listed(slave, "/left/camera", "/filter")
    memo = from_memo(to_memo(slave.of("c").memo))
    assert memo is not None
    other = Slave()
    status = InstanceStatus(C, InstanceState.RUNNING, PID)
    other.step(SupervisorReplaced((status,), {C: memo}))
    assert other.of("c").status.state is InstanceState.READY
    for one in (slave, other):
        one.status(InstanceState.BACKOFF, "c")
        one.status(InstanceState.RUNNING, "c", pid=6)
        assert one.step(SeenInGraph(C)) == [ListComponents(C, 6, "/robot/c/_container")]
        stale = one.step(ComponentsListed(C, PID, frozenset({"/left/camera", "/filter"})))
        assert stale == [], "the answer of the former run"


def test_a_restored_container_is_loaded_from_its_second_run_on() -> None:
    """Its image has all components; a later run starts without any."""
    slave = Slave()
    slave.assign(SPEC, restored=True)
    assert states(slave.status(InstanceState.RUNNING, "c")) == [InstanceState.READY]
    slave.status(InstanceState.BACKOFF, "c")
    slave.status(InstanceState.RUNNING, "c", pid=6)
    assert slave.step(SeenInGraph(C)) == [ListComponents(C, 6, "/robot/c/_container")]


def test_a_component_gets_the_devices_and_artifacts_of_its_container() -> None:
    """They stand in its parameters and extra arguments; other texts and numbers stay."""
    model, root = Artifact("model", "0" * 64, 5), Path("/cache")
    status = InstanceStatus(C, InstanceState.RUNNING, PID)
    held = HeldInstance(status, devices=(HeldDevice("camera", "front"),), artifacts=(model,))
    component = Component(
        "m:Camera", "{device.camera}", arguments={"log": "{device.camera}.log"},
        parameters={"source": "{device.camera}", "models": ["{artifacts}/model"], "rate": 5},
    )  # fmt: skip
    front = Device("camera", "front", "/dev/video0")

    def filled(*devices: Device) -> Component:
        return filled_component(component, held, devices=devices, artifacts=root, prefixes=())

    directory = set_directory(root, (model,))
    assert filled(front) == Component(
        "m:Camera", "{device.camera}", arguments={"log": "/dev/video0.log"},
        parameters={"source": "/dev/video0", "models": [f"{directory}/model"], "rate": 5},
    )  # fmt: skip
    with pytest.raises(LaunchError, match="camera front is no device of this host now"):
        filled()


def test_a_component_whose_container_has_ended_is_not_loaded(tmp_path) -> None:
    """The order to load may be older than the end of the container; the error says so."""
    with pytest.raises(LaunchError, match="its container has ended"):
        filled_component(CAMERA, None, devices=(), artifacts=tmp_path, prefixes=())
