"""Tells by its keys what a file configures."""

from __future__ import annotations

from dataclasses import fields
from typing import Final

from rosrm.config.documents import Node
from rosrm.config.settings import ClusterConfig, HostConfig
from rosrm.errors import ConfigError

_KEYS: Final = {
    "cluster": {f.name for f in fields(ClusterConfig)},
    "host": {f.name for f in fields(HostConfig)},
    "work": {"processes", "defaults"},
}


def kind_of(root: Node) -> str:
    """The kind of file: "cluster", "host" or "work".

    Raises:
        ConfigError: its keys fit none, or several as well.
    """
    given = set(root.items)
    fits = {kind: len(given & keys) for kind, keys in _KEYS.items()}
    most = max(fits.values())
    best = [kind for kind, count in fits.items() if count == most]
    if most and len(best) == 1:
        return best[0]
    if most:
        said = f"its keys fit a {' and a '.join(best)} file alike"
    else:
        said = "it has no key of a cluster, host or work file"
    raise ConfigError(f"{root.place}: {said}; say which with --kind")
