"""The probe `gpu`, with a fake driver."""

import ctypes
import sys
from types import SimpleNamespace

import pytest

from rosrm.errors import ConfigError, SkipPlugin
from rosrm.testing import probe_context
from rosrm_resources import gpu
from rosrm_resources.gpu import GpuOptions, GpuProbe

GIB = 2**30


class FakeNvml:
    """The part of `pynvml` that the probe uses; for each GPU (percent busy, bytes used, total)."""

    class NVMLError(Exception):
        pass

    def __init__(self, *devices):
        self.devices = devices
        self.shut_down = 0

    def nvmlInit(self):  # noqa: N802 - the driver's name
        return None

    def nvmlShutdown(self):  # noqa: N802
        self.shut_down += 1

    def nvmlDeviceGetCount(self):  # noqa: N802
        return len(self.devices)

    def nvmlDeviceGetHandleByIndex(self, index):  # noqa: N802
        return index

    def nvmlDeviceGetUtilizationRates(self, handle):  # noqa: N802
        return SimpleNamespace(gpu=self._told(self.devices[handle][0]), memory=0)

    def nvmlDeviceGetMemoryInfo(self, handle):  # noqa: N802
        _, used, total = self.devices[handle]
        return SimpleNamespace(used=self._told(used), total=total)

    def _told(self, value):
        if value is None:
            raise self.NVMLError("Not Supported")
        return value


def readings(probe):
    return {reading.resource: reading.usage for reading in probe.read()}


def capacities(probe):
    return {resource.name: resource.capacity for resource in probe.resources}


def test_one_gpu():
    """Utilisation is a fraction, and memory is relative to its size."""
    probe = GpuProbe(GpuOptions(), FakeNvml((40, 20 * GIB, 80 * GIB)))
    assert capacities(probe) == {"gpu": 1.0, "gpu_memory": 80.0 * GIB}
    assert readings(probe) == pytest.approx({"gpu": 0.4, "gpu_memory": 0.25})


def test_of_several_the_fullest_counts():
    """A process that fits the fullest GPU fits whichever GPU it gets."""
    probe = GpuProbe(GpuOptions(), FakeNvml((10, 8 * GIB, 16 * GIB), (90, 8 * GIB, 80 * GIB)))
    assert capacities(probe) == {"gpu": 1.0, "gpu_memory": 16.0 * GIB}
    assert readings(probe) == pytest.approx({"gpu": 0.9, "gpu_memory": 0.5})


def test_of_several_the_mean():
    """For processes that use several GPUs, capacity and usage are those of all together."""
    nvml = FakeNvml((10, 8 * GIB, 16 * GIB), (90, 0, 16 * GIB))
    probe = GpuProbe(GpuOptions(combine="mean"), nvml)
    assert capacities(probe) == {"gpu": 2.0, "gpu_memory": 32.0 * GIB}
    assert readings(probe) == pytest.approx({"gpu": 0.5, "gpu_memory": 0.25})


def test_chosen_devices_only():
    """Devices that were not chosen are not measured."""
    probe = GpuProbe(GpuOptions(devices=(1,)), FakeNvml((100, 1, 1), (20, 4, 8)))
    assert readings(probe) == pytest.approx({"gpu": 0.2, "gpu_memory": 0.5})


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


def test_driver_without_a_gpu_is_absent_and_let_go(driver):
    """The driver is closed again."""
    nvml = driver(FakeNvml())
    with pytest.raises(SkipPlugin, match="sees no GPU"):
        gpu.create(GpuOptions(), probe_context())
    assert nvml.shut_down == 1


def test_close_lets_go_of_the_driver(driver):
    """The driver is closed once."""
    nvml = driver(FakeNvml((0, 0, 1)))
    gpu.create(GpuOptions(), probe_context()).close()
    assert nvml.shut_down == 1
