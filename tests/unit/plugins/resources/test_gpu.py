"""The probe `gpu`, with a fake driver."""

import ctypes
import sys
from types import SimpleNamespace

import pytest

from rosrm import Device
from rosrm.errors import ConfigError, SkipPlugin
from rosrm.testing import probe_context
from rosrm_resources import gpu
from rosrm_resources.gpu import GpuOptions, GpuProbe

GIB = 2**30


class FakeNvml:
    """The part of `pynvml` that the probe uses; for each GPU (percent busy, bytes used, total)."""

    class NVMLError(Exception):
        value = 0  # as of the subclass of each error

    def __init__(self, *devices):
        self.devices = devices
        self.computing = [{} for _ in devices]
        self.drawing = [{} for _ in devices]
        self.shut_down = 0
        self.models = ["NVIDIA X"] * len(devices)
        self.errors = {}

    def nvmlInit(self):  # noqa: N802 - the driver's name
        return None

    def nvmlShutdown(self):  # noqa: N802
        self.shut_down += 1

    def nvmlDeviceGetCount(self):  # noqa: N802
        return len(self.devices)

    def nvmlDeviceGetHandleByIndex(self, index):  # noqa: N802
        return index

    def nvmlDeviceGetName(self, handle):  # noqa: N802
        return self._told(self.models[handle])

    def nvmlDeviceGetUUID(self, handle):  # noqa: N802
        if handle in self.errors:
            error = self.NVMLError(f"code {self.errors[handle]}")
            error.value = self.errors[handle]
            raise error
        return f"GPU-{handle}"

    def nvmlDeviceGetUtilizationRates(self, handle):  # noqa: N802
        return SimpleNamespace(gpu=self._told(self.devices[handle][0]), memory=0)

    def nvmlDeviceGetMemoryInfo(self, handle):  # noqa: N802
        _, used, total = self.devices[handle]
        return SimpleNamespace(used=self._told(used), total=total)

    def nvmlDeviceGetComputeRunningProcesses(self, handle):  # noqa: N802
        return self._running(self.computing[handle])

    def nvmlDeviceGetGraphicsRunningProcesses(self, handle):  # noqa: N802
        return self._running(self.drawing[handle])

    def _running(self, memory_of_pid):
        memory = self._told(memory_of_pid)
        return [SimpleNamespace(pid=pid, usedGpuMemory=used) for pid, used in memory.items()]

    def _told(self, value):
        if value is None:
            raise self.NVMLError("Not Supported")
        return value


def readings(probe):
    return {reading.resource: reading.usage for reading in probe.read()}


def capacities(probe):
    return {resource.name: resource.capacity for resource in probe.resources}


@pytest.mark.parametrize(
    ("options", "devices", "capacity", "usage"),
    [
        (GpuOptions(), [(40, 20, 80)], (1.0, 80.0), (0.4, 0.25)),
        # A process that fits the fullest GPU fits whichever GPU it gets.
        (GpuOptions(), [(10, 8, 16), (90, 8, 80)], (1.0, 16.0), (0.9, 0.5)),
        # A process may use several GPUs: capacity and usage are those of all together.
        (GpuOptions(combine="mean"), [(10, 8, 16), (90, 0, 16)], (2.0, 32.0), (0.5, 0.25)),
        (GpuOptions(devices=(1,)), [(100, 1, 1), (20, 4, 8)], (1.0, 8.0), (0.2, 0.5)),
    ],
    ids=["one", "the fullest", "the mean", "the chosen one"],
)
def test_capacity_and_usage(options, devices, capacity, usage):
    """Utilisation is a fraction, and memory is relative to its size."""
    nvml = FakeNvml(*((busy, used * GIB, total * GIB) for busy, used, total in devices))
    probe = GpuProbe(options, nvml)
    assert capacities(probe) == {"gpu": capacity[0], "gpu_memory": capacity[1] * GIB}
    assert readings(probe) == pytest.approx({"gpu": usage[0], "gpu_memory": usage[1]})


@pytest.mark.parametrize(("combine", "expected"), [("max", 3 * GIB), ("mean", 5 * GIB)])
def test_gpu_memory_of_processes(combine, expected):
    """A process that computes and draws, on two GPUs, counts as one; the resource is attributed."""
    nvml = FakeNvml((0, 0, 8 * GIB), (0, 0, 8 * GIB))
    nvml.computing = [{7: 2 * GIB, 8: None}, {7: 3 * GIB}]
    nvml.drawing[0] = {7: 2 * GIB}
    probe = GpuProbe(GpuOptions(combine=combine), nvml)
    assert [one.accounting for one in probe.resources] == ["shared", "attributed"]
    assert probe.by_process() == {"gpu_memory": {7: expected, 8: 0.0}}


@pytest.mark.parametrize("cause", ["the driver does not tell", "pids of another namespace"])
def test_gpu_memory_is_shared_where_processes_cannot_be_told_apart(cause):
    """As on a Jetson, or in a container."""
    nvml = FakeNvml((0, 0, 8 * GIB))
    seen = cause.startswith("pids")
    if not seen:
        nvml.computing = [None]
    probe = GpuProbe(GpuOptions(), nvml, same_pids=not seen)
    assert [one.accounting for one in probe.resources] == ["shared", "shared"]
    assert probe.by_process() == {}


def test_each_gpu_is_a_device_by_its_index():
    """The index is that by which CUDA_VISIBLE_DEVICES selects the GPU."""
    probe = GpuProbe(GpuOptions(devices=(1, 2)), FakeNvml(*[(0, 0, 8 * GIB)] * 3))
    about = "NVIDIA X, 8 GiB"
    assert probe.devices() == [Device("gpu", "1", about=about), Device("gpu", "2", about=about)]


@pytest.mark.parametrize("code", [6, 15, 28], ids=["not found", "lost", "GPU not found"])
def test_a_gpu_that_the_driver_lost_is_missing_until_it_is_back(code):
    """The other GPUs are still offered."""
    nvml = FakeNvml((0, 0, GIB), (0, 0, GIB))
    probe = GpuProbe(GpuOptions(), nvml)
    nvml.errors = {1: code}
    assert [one.missing for one in probe.devices()] == ["", f"NVML: code {code}"]
    nvml.errors = {}
    assert [one.missing for one in probe.devices()] == ["", ""]


@pytest.mark.parametrize("code", [1, 4, 9, 10, 16, 18, 20, 23, 999])
def test_a_driver_that_cannot_tell_leaves_each_gpu_as_it_was(code):
    """Otherwise its time-out or lack of memory would end the processes on all GPUs."""
    nvml = FakeNvml((0, 0, GIB), (0, 0, GIB))
    probe = GpuProbe(GpuOptions(), nvml)
    nvml.errors = {1: 15}
    before = probe.devices()
    nvml.errors = {0: code, 1: code}
    assert probe.devices() == before
    nvml.errors = {}
    assert [one.missing for one in probe.devices()] == ["", ""]


@pytest.mark.parametrize(
    ("models", "labels"),
    [
        (["X", "X"], {"gpu.model": "X", "gpu.memory": "8 GiB"}),
        (["X", "Y"], {"gpu.memory": "8 GiB"}),
        ([b"X", b"X"], {"gpu.model": "X", "gpu.memory": "8 GiB"}),
        ([None, None], {"gpu.memory": "8 GiB"}),
    ],
    ids=["equal", "different", "an old driver", "not told"],
)
def test_labels_of_gpus(models, labels):
    """Model and memory are labels if they are the same for all GPUs."""
    nvml = FakeNvml((0, 0, 8 * GIB), (0, 0, 8 * GIB))
    nvml.models = models
    assert GpuProbe(GpuOptions(), nvml).labels == labels


def test_unknown_device_is_refused():
    """The error lists the existing devices."""
    with pytest.raises(ConfigError, match=r"devices \[3\] do not exist; there are 2: 0 to 1"):
        GpuProbe(GpuOptions(devices=(0, 3)), FakeNvml((0, 0, 1), (0, 0, 1)))


def test_what_a_gpu_does_not_tell_is_left_out():
    """A GPU cut into instances has no utilisation; its memory is read all the same."""
    probe = GpuProbe(GpuOptions(), FakeNvml((None, 4, 8)))
    assert capacities(probe) == {"gpu_memory": 8.0}
    with pytest.raises(SkipPlugin, match="neither its utilisation nor its memory"):
        GpuProbe(GpuOptions(), FakeNvml((None, None, 8)))


def test_no_driver_is_absent_with_the_reason(monkeypatch):
    """The probe searches for the library before the import of the module."""

    def missing(name):
        raise OSError(f"{name}: cannot open shared object file")

    monkeypatch.setattr(ctypes, "CDLL", missing)
    monkeypatch.setitem(sys.modules, "pynvml", None)  # importing it would raise
    with pytest.raises(SkipPlugin, match=r"no NVIDIA driver: libnvidia-ml.so.1 is not installed"):
        gpu.create(GpuOptions(), probe_context())


@pytest.fixture
def driver(monkeypatch):
    """Install a fake driver on this machine."""

    def install(nvml):
        monkeypatch.setattr(ctypes, "CDLL", lambda name: None)
        monkeypatch.setitem(sys.modules, "pynvml", nvml)
        return nvml

    return install


def test_driver_that_does_not_run_is_absent(driver):
    """A container without a GPU has such a driver."""
    nvml = driver(FakeNvml())

    def refuse():
        raise nvml.NVMLError("Driver Not Loaded")

    nvml.nvmlInit = refuse
    with pytest.raises(SkipPlugin, match="no NVIDIA driver: Driver Not Loaded"):
        gpu.create(GpuOptions(), probe_context())


def test_the_driver_is_closed_once(driver):
    """The probe closes the driver, also where no GPU is found."""
    nvml = driver(FakeNvml())
    with pytest.raises(SkipPlugin, match="sees no GPU"):
        gpu.create(GpuOptions(), probe_context())
    assert nvml.shut_down == 1
    nvml = driver(FakeNvml((0, 0, 1)))
    gpu.create(GpuOptions(), probe_context()).close()
    assert nvml.shut_down == 1
