"""Settings that apply without a restart, and the difference between two versions of settings."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field, fields, is_dataclass, replace
from typing import Any, Final, Generic, TypeVar

Config = TypeVar("Config")

#: Settings of a master that apply without a restart: sections, or keys of a section.
OF_CLUSTER: Final = (
    "scoring", "migration.cooldown", "migration.hysteresis", "migration.headroom",
    "migration.need", "migration.max_in_flight", "migration.automatic", "queue", "rebalance",
    "quotas", "defaults", "delivery_timeout", "max_hosts",
)  # fmt: skip
#: The same of a slave.
OF_HOST: Final = ("labels", "limits", "devices")
#: Sections with other keys in a file than as a value.
_AS_A_WHOLE: Final = ("ros",)


@dataclass(frozen=True, slots=True)
class Reloaded(Generic[Config]):
    """Settings after a reload.

    Attributes:
        config: the former settings with those changes that need no restart.
        changed: paths of these changes.
        kept: paths of settings that differ and need a restart.
    """

    config: Config
    changed: tuple[str, ...]
    kept: tuple[str, ...]


def reloaded(old: Config, new: Config, reloadable: Collection[str]) -> Reloaded[Config]:
    """Return old settings with the changes in new ones that need no restart."""
    difference = _Difference(reloadable)
    config = difference.merge(old, new, "")
    return Reloaded(config, tuple(difference.changed), tuple(difference.kept))


@dataclass(slots=True)
class _Difference:
    reloadable: Collection[str]
    changed: list[str] = field(default_factory=list)
    kept: list[str] = field(default_factory=list)

    def merge(self, old: Any, new: Any, path: str) -> Any:
        """Return the merged value at a path, and note its changes."""
        if old == new:
            return old
        if path in self.reloadable:
            self.changed.append(path)
            return new
        if path in _AS_A_WHOLE or not is_dataclass(old) or type(old) is not type(new):
            self.kept.append(path)
            return old
        merged = {
            one.name: self.merge(
                getattr(old, one.name), getattr(new, one.name), f"{path}.{one.name}".lstrip(".")
            )
            for one in fields(old)
        }
        return replace(old, **merged)  # type: ignore[type-var]
