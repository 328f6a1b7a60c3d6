"""Plugin hook that registers the probes."""

from __future__ import annotations

from collections.abc import Sequence

from rosrm import ProbeOffer, hookimpl
from rosrm_resources import cpu, disk, gpu, memory, network


@hookimpl
def register_probes() -> Sequence[ProbeOffer]:
    """Offer `cpu`, `memory`, `disk` and `gpu`, which are read by default, and `network`."""
    return [
        ProbeOffer(
            name="cpu",
            create=cpu.create,
            options=cpu.CpuOptions,
            summary="cores in use: machine, cgroup or slice",
            default=True,
        ),
        ProbeOffer(
            name="memory",
            create=memory.create,
            options=memory.MemoryOptions,
            summary="bytes in use, without cache that can be dropped: machine, cgroup or slice",
            default=True,
        ),
        ProbeOffer(
            name="disk",
            create=disk.create,
            options=disk.DiskOptions,
            summary="bytes in use where the slave keeps its files: file system or slice",
            period=1.0,
            deadline=2.0,
            default=True,
        ),
        ProbeOffer(
            name="gpu",
            create=gpu.create,
            options=gpu.GpuOptions,
            summary="NVIDIA GPUs: utilisation (gpu), memory (gpu_memory), devices and labels",
            period=0.5,
            deadline=2.0,
            default=True,
            resources=("gpu", "gpu_memory"),
        ),
        ProbeOffer(
            name="network",
            create=network.create,
            options=network.NetworkOptions,
            summary="the busiest physical link in its busier direction",
            period=0.5,
        ),
    ]
