"""Configuration files `cluster.yaml`, `host.yaml` and `work.yaml`: loaders with all checks.

The settings themselves (`rosrm.config.settings`) import without pydantic and YAML, because the
runtimes of master and slave need only those. The loaders are imported on first use.
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
