"""Devices of a slave: those of its settings and of its probes, and what a process gets of them."""

from __future__ import annotations

import errno
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import yaml

from rosrm import threads
from rosrm.core.slave.watches import Memo
from rosrm.errors import LaunchError, describe_fault
from rosrm.extensions.made import FailedProbe
from rosrm.model.devices import Device, DeviceNeed, HeldDevice
from rosrm.model.values import EMPTY, Assignment, InstanceId, ProcessSpec
from rosrm.runtime.path_calls import NoAnswer, PathCall, PathCalls, run_at_once
from rosrm.slave.devices import DeviceWatch, FileFaults
from rosrm.slave.launch.command import order_of, plain_launch
from rosrm.slave.launch.environment import ProcessLocation
from rosrm.slave.launch.launchers import Launchers
from rosrm.slave.memos import from_memo, to_memo
from rosrm.slave.sampler import Finding, Sampler
from rosrm.testing import FakeClock, FakeProbe, made_probe
from tests.waiting import PATIENCE

GPU = Device("gpu", "0", about="a model")


def looked(watch: DeviceWatch, found=EMPTY, at: float = 0.0, awaits: bool = False) -> bool:
    """Look at the devices and their files once; the probes have found theirs at that time, too."""
    findings = {name: Finding(devices, at) for name, devices in found.items()}
    return watch.look(findings, awaits, FileFaults(run_at_once, lambda: None, lambda: at))


# --- the devices of a host -----------------------------------------------------------------------


def test_a_device_whose_file_is_gone_is_missing_until_the_file_is_back(tmp_path: Path) -> None:
    """The device is lost after two looks a second apart, so that a driver may start again."""
    path = tmp_path / "video0"
    watch = DeviceWatch({"camera": (Device("camera", "front", str(path)),)})
    assert looked(watch)
    gone = f"{path}: No such file or directory"
    assert ([one.missing for one in watch.devices], watch.lost) == ([gone], {})
    assert not looked(watch, at=0.01)  # such as after the change of another device
    assert watch.lost == {}
    assert not looked(watch, at=1.0)
    assert watch.lost == {("camera", "front"): gone}
    path.touch()
    assert looked(watch, at=1.01)
    assert ([one.missing for one in watch.devices], watch.lost) == ([""], {})
    path.unlink()
    assert looked(watch, at=5.0)
    assert ([one.missing for one in watch.devices], watch.lost) == ([gone], {})


def test_a_file_that_is_absent_for_a_moment_loses_no_device(tmp_path: Path) -> None:
    """The look after the change begins a measurement whose result the next look gets."""
    path, clock = tmp_path / "video0", FakeClock()
    posted: list[Callable[[], None]] = []
    watch = DeviceWatch({"camera": (Device("camera", "front", str(path)),)})

    def run(work: Any, then: Any, failed: Any) -> PathCall:
        return run_at_once(work, lambda fault: posted.append(lambda: then(fault)), failed)

    def look() -> None:
        watch.look({}, False, faults)

    faults = FileFaults(run, look, clock)
    look()  # finds it gone, as the next one does at once
    for _ in range(2):
        posted.pop(0)()
    path.touch()
    clock.advance(1.02)
    look()
    assert (watch.devices[0].missing != "", watch.lost) == (True, {})
    posted.pop(0)()
    assert watch.devices[0].missing == ""


def test_two_looks_at_the_same_reading_of_a_probe_lose_no_device() -> None:
    """A probe may have a longer period than the looks."""
    watch = DeviceWatch({})
    gone = {"finder": Finding((replace(GPU, missing="it has fallen off the bus"),), 3.0)}
    for _ in range(3):
        watch.look(gone, False, lambda _path: ("", 0.0))
        assert watch.lost == {}
    watch.look({"finder": gone["finder"]._replace(at=13.0)}, False, lambda _path: ("", 0.0))
    assert list(watch.lost) == [("gpu", "0")]


def test_a_unit_that_another_probe_may_find_is_not_lost() -> None:
    """After a restart of the slave, one of two probes of a kind may be late or fail."""
    configured = (GPU, Device("gpu", "a0"))
    watch = DeviceWatch({"gpu": configured})
    for at in (0.0, 1.0, 2.0):
        looked(watch, {"nvidia": (GPU,)}, at=at, awaits=True)
    assert [one.missing != "" for one in watch.devices] == [False, True]
    assert watch.lost == {}
    for at in (3.0, 4.0):
        looked(watch, {"nvidia": (GPU,), "amd": ()}, at=at)
    assert list(watch.lost) == [("gpu", "a0")]


def test_a_probe_that_has_not_said_which_devices_are_there_is_awaited() -> None:
    """As is one that could not be created; one that finds no devices is not."""
    failing = Finder(OSError("no bus"))
    failed = FailedProbe((), "cannot be created")
    for probe, awaits in ((failing, True), (failed, True), (FakeProbe(cpu=0.5), False)):
        sampler = sampled(probe)
        assert sampler.awaits_devices is awaits
        sampler.close()


@pytest.mark.parametrize(
    "error",
    [
        OSError(errno.EMFILE, "Too many open files"), PermissionError(errno.EACCES, "no"),
        OSError(errno.ESTALE, "Stale file handle"), NoAnswer("/dev/x does not answer (10 s)"),
        MemoryError(),
    ],
)  # fmt: skip
@pytest.mark.parametrize("is_there", [True, False])
def test_a_look_that_cannot_be_made_leaves_a_device_as_it_was(
    tmp_path, monkeypatch, caplog, error, is_there
) -> None:
    """Otherwise a shortage of this machine would end each process that holds a device."""
    path = tmp_path / "video0"
    path.touch()
    watch = DeviceWatch({"camera": (Device("camera", "front", str(path)),)})
    faults = FileFaults(run_at_once, lambda: None)
    watch.look({}, False, faults)
    if not is_there:
        path.unlink()
        watch.look({}, False, faults)
    before = watch.devices

    def refuse(_path: Path) -> None:
        raise error

    caplog.set_level("INFO")
    with monkeypatch.context() as shortage:
        shortage.setattr(Path, "stat", refuse)
        changes = [watch.look({}, False, faults) for _ in range(3)]
    assert not any(changes)
    assert watch.devices == before
    assert [one.message for one in caplog.records].count(
        f"device file {path}: not checked, so the last state stays "
        f"({'it is there' if is_there else before[0].missing}): {describe_fault(error)}"
    ) == 1  # fmt: skip


def test_a_slave_without_another_thread_keeps_its_devices(tmp_path, monkeypatch) -> None:
    """The limit of the user on processes may be used up by others."""

    def refuse(*_: object, **__: object) -> None:
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr(threads, "start", refuse)
    posted: list[Callable[[], None]] = []
    faults = FileFaults(PathCalls("paths", posted.append).run, lambda: None)
    watch = DeviceWatch({"camera": (Device("camera", "front", str(tmp_path)),)})
    for _ in range(3):
        watch.look({}, False, faults)
        while posted:
            posted.pop()()
    assert [one.missing for one in watch.devices] == [""]


def test_the_devices_of_probes_are_those_of_the_host() -> None:
    """As long as the settings name no unit of their kind."""
    watch = DeviceWatch({"lidar": (Device("lidar", "lidar", shareable=4),)})
    looked(watch, {"gpu": (GPU,), "usb": (Device("imu", "x"),)})
    assert [one.title for one in watch.devices] == ["lidar", "gpu 0", "imu x"]


def test_the_settings_choose_the_units_of_a_kind() -> None:
    """The probe says which of them are there; without a probe of the kind they are taken as is."""
    configured = {"gpu": (Device("gpu", "0"), Device("gpu", "7")), "tpu": ()}
    watch = DeviceWatch(configured)
    looked(watch, {"gpu": (GPU, Device("gpu", "1")), "tpu": (Device("tpu", "0"),)})
    assert watch.devices == (
        GPU, Device("gpu", "7", missing="no probe finds it; found: 0 and 1"),
    )  # fmt: skip
    looked(watch)
    assert watch.devices == configured["gpu"]


class Finder(FakeProbe):
    """A probe that finds devices, or answers something else."""

    def __init__(self, found: object) -> None:
        super().__init__(cpu=0.5)
        self.found = found

    def devices(self) -> object:
        if isinstance(self.found, Exception):
            raise self.found
        return self.found


def sampled(probe: FakeProbe, clock: FakeClock | None = None) -> Sampler:
    """Return a sampler after its first reading, which no load of the machine makes a late one."""
    sampler = Sampler([made_probe("finder", probe)], clock=clock or FakeClock())
    sampler.first(PATIENCE)
    return sampler


def test_a_probe_that_cannot_read_still_says_which_devices_are_there() -> None:
    """The driver may refuse a reading because of the device that is missing."""
    probe = Finder([GPU])
    probe.fault = OSError("no answer")
    sampler = sampled(probe)
    assert {name: one.devices for name, one in sampler.devices.items()} == {"finder": (GPU,)}
    sampler.close()


def test_a_device_of_a_subclass_is_copied_as_a_device(tmp_path: Path) -> None:
    """The slave makes copies of devices, which a subclass with another signature refuses."""

    class Camera(Device):
        def __init__(self) -> None:
            super().__init__("camera", "front", str(tmp_path / "gone"))

    sampler = sampled(Finder([Camera()]))
    watch = DeviceWatch({})
    watch.look(sampler.devices, False, FileFaults(run_at_once, lambda: None))
    sampler.close()
    assert [one.title for one in watch.devices if one.missing] == ["camera front"]


def test_a_missing_unit_of_a_kind_with_very_many_units_has_a_short_reason() -> None:
    """The master would refuse a longer one, with the whole report."""
    units = tuple(Device("gpu", f"{number:064}") for number in range(200))
    watch = DeviceWatch({"gpu": (Device("gpu", "x"),)})
    looked(watch, {"finder": units})
    (missing,) = watch.devices
    assert missing.missing.startswith("no probe finds it; found: 000")
    assert len(missing.missing) < 1000


@pytest.mark.parametrize(
    ("answer", "reason"),
    [
        (OSError("no bus"), "devices() raised OSError: no bus"),
        (7, "devices() answered a int; a list of Devices is required"),
        (["gpu"], "Device is required"),
        ([GPU, GPU], "devices(): gpu 0 is given twice"),
        ([Device("gpu", "../x")], "devices(): gpu: '../x' cannot be a unit"),
        ([Device("gpu", "0", shareable=2.0)], "gpu 0: shareable is 2.0; allowed: 1 to"),
    ],
)
def test_a_probe_that_answers_no_devices_is_stale_with_the_reason(answer, reason) -> None:
    """Its readings are used no longer, and the devices that it found before stay."""
    probe, clock = Finder([GPU]), FakeClock()
    sampler = sampled(probe, clock)
    probe.found = answer
    sampler.latest(clock.advance(1.0))
    assert sampler.settle(PATIENCE)
    (report,) = sampler.latest(clock.now).reports
    assert reason in str(report)
    assert {name: one.devices for name, one in sampler.devices.items()} == {"finder": (GPU,)}
    sampler.close()


# --- what a process gets -------------------------------------------------------------------------


def order(tmp_path: Path, held: tuple[HeldDevice, ...], *there: Device, base=None, **fields):
    """Return the order to start a process that holds devices."""
    fields = {"command": ("x",), "devices": tuple(DeviceNeed(one.kind) for one in held), **fields}
    spec, instance = ProcessSpec("p", **fields), InstanceId("p", 1)
    where = ProcessLocation("h", "c", "/s", devices=there)
    plain = plain_launch(
        Assignment(instance, spec, 1, "p", devices=held), base or {}, "python", where=where,
        state_directory=tmp_path, launchers=Launchers(),
    )  # fmt: skip
    return order_of(plain, Launchers(), where.host)


def test_environment_of_a_process_with_devices(tmp_path: Path) -> None:
    """Paths, or names of units without a path; CUDA sees the units by the driver's index."""
    held = (HeldDevice("gpu", "1"), HeldDevice("gpu", "0", 0.5), HeldDevice("usb-cam", "top"))
    camera = Device("usb-cam", "top", "/dev/video0")
    base = {"ROSRM_DEVICE_OLD": "x", "CUDA_VISIBLE_DEVICES": "3"}
    environment = order(
        tmp_path, held, Device("gpu", "0"), Device("gpu", "1"), camera, base=base,
        devices=(), environment={"CUDA_VISIBLE_DEVICES": "5"},
    ).environment  # fmt: skip
    assert {name: value for name, value in environment.items() if "DEVICE" in name} == {
        "ROSRM_DEVICE_GPU": "1,0", "ROSRM_DEVICE_USB_CAM": "/dev/video0",
        "CUDA_VISIBLE_DEVICES": "1,0", "CUDA_DEVICE_ORDER": "PCI_BUS_ID",
    }  # fmt: skip


def test_a_process_without_devices_keeps_the_variables_of_its_slave(tmp_path: Path) -> None:
    """The process may use a GPU without asking for one, as before."""
    environment = order(tmp_path, (), base={"CUDA_VISIBLE_DEVICES": "3"}).environment
    assert environment["CUDA_VISIBLE_DEVICES"] == "3"


def test_devices_in_arguments_and_parameters(tmp_path: Path) -> None:
    """Other braces stay as they are."""
    launched = order(
        tmp_path, (HeldDevice("camera", "front"),), Device("camera", "front", "/dev/video0"),
        arguments=("--source={device.camera}", "{device.gpu}{x}"), ros=True,
        parameters={"source": "{device.camera}", "all": ["{device.camera}"], "rate": 5},
    )  # fmt: skip
    assert launched.argv[1:3] == ("--source=/dev/video0", "{device.gpu}{x}")
    file = launched.argv[launched.argv.index("--params-file") + 1]
    (parameters,) = yaml.safe_load(launched.contents[file]).values()
    assert parameters["ros__parameters"] == {
        "source": "/dev/video0", "all": ["/dev/video0"], "rate": 5,
    }  # fmt: skip


def test_devices_in_command_and_environment(tmp_path: Path) -> None:
    """A user who writes all words under `command` gets the same."""
    launched = order(
        tmp_path, (HeldDevice("camera", "front"),), Device("camera", "front", "/dev/video0"),
        command=("see", "{device.camera}"), environment={"SOURCE": "{device.camera}"},
    )  # fmt: skip
    assert launched.argv == ("see", "/dev/video0")
    assert launched.environment["SOURCE"] == "/dev/video0"


def test_an_assignment_without_its_device_is_refused(tmp_path: Path) -> None:
    """The process would use a device that another process holds."""
    with pytest.raises(LaunchError, match="p#1: it was assigned without a camera"):
        order(tmp_path, (), devices=(DeviceNeed("camera"),))
    with pytest.raises(LaunchError, match="p#1: camera front is no device of this host now"):
        order(tmp_path, (HeldDevice("camera", "front"),), Device("camera", "rear"))


def test_a_later_run_of_the_slave_knows_the_devices_of_an_instance() -> None:
    """The supervisor stores them; a memo of an earlier version has none."""
    memo = Memo(devices=(HeldDevice("gpu", "0", 0.5),))
    assert from_memo(to_memo(memo)) == memo
    assert from_memo(json.dumps({"awaited": None, "watch": None})) == Memo()
