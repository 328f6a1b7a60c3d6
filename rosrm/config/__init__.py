"""Reads `cluster.yaml`, `host.yaml` and `work.yaml`, and refuses what is wrong at the edge.

The settings themselves (`rosrm.config.settings`) import without pydantic and YAML: the runtimes of
master and slave need only those, and the loaders here are imported when they are first asked for.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from rosrm.config.cluster import load_cluster
    from rosrm.config.host import load_host
    from rosrm.config.settings import ClusterConfig, HostConfig
    from rosrm.config.work import load_work

__all__ = ["ClusterConfig", "HostConfig", "load_cluster", "load_host", "load_work"]

_HOMES: Final = {
    "ClusterConfig": "settings",
    "HostConfig": "settings",
    "load_cluster": "cluster",
    "load_host": "host",
    "load_work": "work",
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
