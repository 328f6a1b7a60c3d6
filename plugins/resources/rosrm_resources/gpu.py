"""Probe `gpu`: utilisation (`gpu`) and memory usage (`gpu_memory`) of NVIDIA GPUs.

The probe also offers each GPU as a device, and adds labels with their model and memory.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, Literal

from rosrm import (
    Accounting,
    ConfigError,
    Count,
    Device,
    ProbeContext,
    Reading,
    ResourceDescription,
    SkipPlugin,
)

_LIBRARY: Final = "libnvidia-ml.so.1"
#: Codes of the driver's errors about a GPU that is not there: NOT_FOUND, GPU_IS_LOST and
#: GPU_NOT_FOUND, which older versions of `pynvml` do not name.
_ABSENT: Final = frozenset({6, 15, 28})
#: Inode of the first pid namespace (`PROC_PID_INIT_INO` of the kernel).
_FIRST_PID_NAMESPACE: Final = 0xEFFFFFFC


@dataclass(frozen=True)
class GpuOptions:
    """Settings of the probe `gpu`.

    Attributes:
        devices: indices of the GPUs that count, as `nvidia-smi` lists them; (): all.
        combine: how several GPUs give one reading. "max": the fullest counts, and the capacity is
            that of the smallest; so a process that takes the first GPU it finds fits on any of
            them. "mean": for processes that use all GPUs; the capacity is the sum.
    """

    devices: tuple[Count, ...] = ()
    combine: Literal["max", "mean"] = "max"


def create(options: GpuOptions, _context: ProbeContext) -> GpuProbe:
    """Create the probe.

    Raises:
        SkipPlugin: this host has no NVIDIA driver or GPU.
    """
    nvml = load_nvml()
    try:
        return GpuProbe(options, nvml, same_pids=_sees_all_pids())
    except BaseException:  # any error: without a probe nothing else closes the driver
        nvml.nvmlShutdown()
        raise


def load_nvml() -> Any:
    """Return the initialised module `pynvml`.

    Raises:
        SkipPlugin: the driver is not installed or not running.
    """
    # Look for the driver first: without one, the module would take 3 MiB for nothing.
    try:
        ctypes.CDLL(_LIBRARY)
    except OSError:
        raise SkipPlugin(f"no NVIDIA driver: {_LIBRARY} is not installed") from None
    import pynvml  # noqa: PLC0415 - see above

    try:
        pynvml.nvmlInit()
    except pynvml.NVMLError as error:
        raise SkipPlugin(f"no NVIDIA driver: {error}") from None
    return pynvml


class GpuProbe:
    """Probe that reads GPUs through NVML.

    Args:
        options: selects the GPUs and combines them into one reading.
        nvml: the module `pynvml`, initialised; the probe shuts it down.
        same_pids: True if the driver reports processes by the pids that this process sees.
    """

    def __init__(self, options: GpuOptions, nvml: Any, *, same_pids: bool = True) -> None:
        self._nvml = nvml
        self._combine: Callable[[list[float]], float] = max if options.combine == "max" else _mean
        self._combine_amounts: Callable[[list[float]], float] = (
            max if options.combine == "max" else sum
        )
        self._handles = _handles(nvml, options.devices)
        self._devices = [
            Device("gpu", str(index), about=self._about(handle))
            for index, handle in zip(
                options.devices or range(len(self._handles)), self._handles, strict=True
            )
        ]
        self._reads: dict[str, Callable[[Any], float]] = {}
        self._resources: list[ResourceDescription] = []
        # A GPU in MIG mode reports no utilisation, and one that is part of a SoC reports no memory.
        self._measures = same_pids and self._can(self._memory_by_process)
        if self._can(self._busy):
            count = 1.0 if options.combine == "max" else float(len(self._handles))
            self._offer("gpu", "1", count, "shared", self._busy)
        if self._can(self._memory):
            sizes = [float(nvml.nvmlDeviceGetMemoryInfo(handle).total) for handle in self._handles]
            size = min(sizes) if options.combine == "max" else sum(sizes)
            accounting: Accounting = "attributed" if self._measures else "shared"
            self._offer("gpu_memory", "B", size, accounting, self._memory)
        if not self._resources:
            raise SkipPlugin("the NVIDIA GPU tells neither its utilisation nor its memory")

    @property
    def resources(self) -> Sequence[ResourceDescription]:
        """Return those of `gpu` and `gpu_memory` that the GPUs report."""
        return self._resources

    def read(self) -> Sequence[Reading]:
        """Return the utilisation over the driver's last sampling period, and the memory in use."""
        return [
            Reading(name, self._combine([usage(handle) for handle in self._handles]))
            for name, usage in self._reads.items()
        ]

    def by_process(self) -> Mapping[str, Mapping[int, float]]:
        """Return the bytes of GPU memory of each process, as far as the driver reports them."""
        if "gpu_memory" not in self._reads or not self._measures:
            return {}
        amounts = [self._memory_by_process(handle) for handle in self._handles]
        pids = {pid for used in amounts for pid in used}
        return {
            "gpu_memory": {
                pid: self._combine_amounts([used.get(pid, 0.0) for used in amounts]) for pid in pids
            }
        }

    @property
    def labels(self) -> Mapping[str, str]:
        """Return model and memory of the GPUs, unless they differ between them."""
        labels = {}
        for name, read in (("gpu.model", self._model), ("gpu.memory", self._size)):
            values = {self._told(read, handle) for handle in self._handles}
            if len(values) == 1 and (value := values.pop()):
                labels[name] = value
        return labels

    def devices(self) -> Sequence[Device]:
        """Return each GPU; one that the driver does not find, or that has left its bus, is missing.

        After any other error of the driver, a GPU stays as it was, because processes end with it.
        """
        self._devices = [
            replace(device, missing=self._fault(handle, device.missing))
            for device, handle in zip(self._devices, self._handles, strict=True)
        ]
        return self._devices

    def close(self) -> None:
        """Shut down the connection to the driver."""
        self._nvml.nvmlShutdown()

    def _offer(
        self, name: str, unit: str, capacity: float, accounting: Accounting,
        usage: Callable[[Any], float],
    ) -> None:  # fmt: skip
        self._resources.append(ResourceDescription(name, unit, capacity, "machine", accounting))
        self._reads[name] = usage

    def _fault(self, handle: Any, before: str) -> str:
        """Return why a GPU is missing; "": it is there. Where the driver cannot tell: as before."""
        try:
            self._nvml.nvmlDeviceGetUUID(handle)
        except self._nvml.NVMLError as error:
            return f"NVML: {error}" if error.value in _ABSENT else before
        return ""

    def _about(self, handle: Any) -> str:
        told = (self._told(self._model, handle), self._told(self._size, handle))
        return ", ".join(filter(None, told))

    def _told(self, read: Callable[[Any], str], handle: Any) -> str:
        """Return a text about a GPU; "" if the driver does not tell it."""
        try:
            return read(handle)
        except self._nvml.NVMLError:
            return ""

    def _model(self, handle: Any) -> str:
        name = self._nvml.nvmlDeviceGetName(handle)
        return name.decode() if isinstance(name, bytes) else str(name)

    def _size(self, handle: Any) -> str:
        return f"{self._nvml.nvmlDeviceGetMemoryInfo(handle).total / 2**30:.0f} GiB"

    def _can(self, usage: Callable[[Any], object]) -> bool:
        try:
            for handle in self._handles:
                usage(handle)
        except self._nvml.NVMLError:
            return False
        return True

    def _busy(self, handle: Any) -> float:
        return float(self._nvml.nvmlDeviceGetUtilizationRates(handle).gpu) / 100.0

    def _memory(self, handle: Any) -> float:
        memory = self._nvml.nvmlDeviceGetMemoryInfo(handle)
        return float(memory.used) / float(memory.total)

    def _memory_by_process(self, handle: Any) -> dict[int, float]:
        """Return the bytes of each process on one GPU; a process may compute and draw at once."""
        used: dict[int, float] = {}
        for running in (
            self._nvml.nvmlDeviceGetComputeRunningProcesses(handle),
            self._nvml.nvmlDeviceGetGraphicsRunningProcesses(handle),
        ):
            for one in running:
                # None: the driver does not tell, as under WSL.
                used[one.pid] = max(used.get(one.pid, 0.0), float(one.usedGpuMemory or 0))
        return used


def _mean(figures: Sequence[float]) -> float:
    """Return the mean; the module `statistics` would cost each slave 0.5 MB."""
    return math.fsum(figures) / len(figures)


def _sees_all_pids() -> bool:
    """Return True if this process is in the first pid namespace, whose pids the driver reports."""
    return Path("/proc/self/ns/pid").stat().st_ino == _FIRST_PID_NAMESPACE


def _handles(nvml: Any, devices: Sequence[int]) -> list[Any]:
    count = int(nvml.nvmlDeviceGetCount())
    if count == 0:
        raise SkipPlugin("the NVIDIA driver sees no GPU")
    unknown = [device for device in devices if device >= count]
    if unknown:
        raise ConfigError(
            f"probe gpu: devices {unknown} do not exist; there are {count}: 0 to {count - 1}"
        )
    return [nvml.nvmlDeviceGetHandleByIndex(device) for device in devices or range(count)]
