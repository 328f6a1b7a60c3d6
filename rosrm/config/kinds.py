"""Kind of a configuration file, by its keys or else by its name."""

from __future__ import annotations

from collections.abc import Mapping
from collections.abc import Set as AbstractSet
from dataclasses import fields
from pathlib import Path
from typing import Final

from rosrm.config.documents import Node
from rosrm.config.settings import ClusterConfig, HostConfig
from rosrm.errors import ConfigError
from rosrm.wording import get_close_matches

#: Keys of a simulation's workload. The distribution `rosrm-simulate` reads such a file, but other
#: commands must recognise it without that distribution.
SIMULATION_KEYS: Final = (
    "name", "seed", "until", "hosts", "processes", "model", "cluster", "variants",
)  # fmt: skip
#: Keys of each kind of file.
_KEYS: Final = {
    "cluster": {f.name for f in fields(ClusterConfig)},
    "host": {f.name for f in fields(HostConfig)},
    "work": {"processes", "defaults"},
    "modes": {"modes"},
    "simulation": {*SIMULATION_KEYS},
}
#: A file without this key is of another kind.
_NEEDED: Final = {"work": "processes", "simulation": "hosts", "modes": "modes"}
#: End of a file's name, before `.yaml`.
_NAMES: Final = {
    "cluster": "cluster", "host": "host", "work": "work", "modes": "modes", "sim": "simulation",
}  # fmt: skip
#: Command that uses a file of each kind.
_COMMANDS: Final = {
    "cluster": "rosrm master --config",
    "host": "rosrm slave --config",
    "work": "rosrm submit",
    "modes": "rosrm mode --load",
    "simulation": "rosrm simulate",
}


def kind_of(root: Node) -> str:
    """Return the kind of file: "cluster", "host", "work", "modes" or "simulation".

    Raises:
        ConfigError: its keys fit no kind, or several equally, and its name fits no kind.
    """
    best = _best(set(root.items))
    if len(best) == 1:
        return best[0]
    stem = Path(root.place.file).stem.replace("-", ".").replace("_", ".")
    named = _NAMES.get(stem.rsplit(".", 1)[-1])
    if named is not None and (named in best or not best):
        return named
    if not isinstance(root.value, Mapping):
        fault = "it is no mapping; in a work file the list is under `processes:`"
        raise ConfigError(f"{root.place}: {fault}")
    if best:
        fault = f"its keys fit a {' and a '.join(best)} file alike"
    else:
        fault = "it has no key of a cluster, host, work, modes or simulation file"
        known = [key for keys in _KEYS.values() for key in keys]
        for key in root.items:
            if close := get_close_matches(key, known, 1):
                hint = f"{key!r}: did you mean {close[0]!r}? Choose one with --kind"
                raise ConfigError(f"{root.place}: {fault}, and {hint}")
    raise ConfigError(f"{root.place}: {fault}; choose one with --kind")


def check_kind(root: Node, wanted: str) -> None:
    """Raise `ConfigError` if most keys belong to another kind of file."""
    given = set(root.items)
    best = _best(given)
    if len(best) != 1 or best[0] == wanted:
        return
    there = _belonging(given, best[0])
    if len(there) * 2 > len(given):
        file, keys = root.place.file, ", ".join(key for key in root.items if key in there)
        raise ConfigError(
            f"{file}: a {wanted} file is required, and this is a {best[0]} file, by its keys "
            f"{keys}; it is for `{_COMMANDS[best[0]]} {file}`"
        )


def _best(given: AbstractSet[str]) -> list[str]:
    """Return the kinds that match most of the keys; none if no kind matches any key."""
    fits = {kind: len(_belonging(given, kind)) for kind in _KEYS}
    most = max(fits.values())
    return [kind for kind, count in fits.items() if count == most > 0]


def _belonging(given: AbstractSet[str], kind: str) -> AbstractSet[str]:
    """Return the keys that belong to a kind of file; none if its required key is missing."""
    without = kind in _NEEDED and _NEEDED[kind] not in given
    return frozenset() if without else given & _KEYS[kind]
