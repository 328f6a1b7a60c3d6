"""Intents: desired states as the journal has them, one for each part that an event has changed."""

from __future__ import annotations

from collections.abc import Sequence
from math import isfinite
from operator import attrgetter
from typing import Any, Final, Protocol

from rosrm.core.master.state.applications import (
    Application,
    Version,
    application_to_dict,
    key_of,
    version_to_dict,
)
from rosrm.core.master.state.migration import Migration, migration_to_dict
from rosrm.core.master.state.modes import Modes, mode_to_dict, modes_to_dict
from rosrm.core.master.state.process import (
    JOURNALED,
    JOURNALED_RESTART,
    Instance,
    PendingAmendment,
    Process,
)
from rosrm.model.codec import fields_to_plain, to_plain
from rosrm.model.modes import Mode
from rosrm.model.records import Intent

#: Faster than `fields_to_plain`: each decision waits until its process is saved.
_journaled_of: Final = attrgetter(*JOURNALED)


class Tables(Protocol):
    """The parts of the master's state that intents of processes and migrations are made of."""

    boot: str
    processes: dict[str, Process]
    instances: dict[int, Instance]
    standbys: dict[str, Migration]
    unamended: dict[str, PendingAmendment]


class Unsaved:
    """Parts of the state that the current event has changed, each by its name.

    The intent of a part is made once, after the event, however often the event changes the part.
    """

    def __init__(self) -> None:
        self.processes: dict[str, Process] = {}
        self.migrations: dict[str, Migration] = {}
        self.applications: dict[str, Application] = {}

    def take(self, tables: Tables) -> list[Intent]:
        """Return the intents of all parts, and clear them."""
        found = [process_intent(tables, one) for one in self.processes.values()]
        found += [migration_intent(tables, one) for one in self.migrations.values()]
        found += [application_intent(one) for one in self.applications.values()]
        self.processes.clear()
        self.migrations.clear()
        self.applications.clear()
        return found


class Unjournaled(Unsaved):
    """Parts of a copied state that plans change; they have no intents."""

    def take(self, tables: Tables) -> list[Intent]:  # noqa: ARG002 - as in the other class
        """Clear all parts."""
        for parts in (self.processes, self.migrations, self.applications):
            parts.clear()
        return []


def process_intent(tables: Tables, process: Process) -> Intent:
    """Return the desired state of a process with its instances and its standby."""
    instances = [(str(number), tables.instances[number]) for number in process.instances]
    owner, left = tables.instances.get(process.owner), process.left_behind
    restart = owner and owner.restarting
    now = process.phase, process.since, process.wall
    phase, since, wall = process.phase_before_loss or now
    standby, pending = tables.standbys.get(process.name), tables.unamended.get(process.name)
    return Intent(
        "process", process.name,
        {
            "spec": process.plain,
            "next_spec": process.next_spec and to_plain(process.next_spec),
            "phase": phase.value, "since": wall, "at": moment(tables.boot, since),
            "host": owner.host.name if owner else process.ended_on,
            "instances": {number: one.host.name for number, one in instances},
            "node_names": {number: one.node_name for number, one in instances if one.node_name},
            "restarts_off": [one.id.number for _, one in instances if one.restarts_off],
            "devices": {number: to_plain(one.devices) for number, one in instances if one.devices},
            "specs": {
                number: to_plain(one.spec) for number, one in instances
                if one.spec is not process.spec and one.spec != process.spec
            },
            "standby": standby and _migration(tables, standby, ()),
            "left_behind": left and to_plain(left),
            "restart": restart and {
                **fields_to_plain(restart, JOURNALED_RESTART),
                "at": moment(tables.boot, restart.ordered_at),
            },
            "image": process.image and to_plain(process.image),
            **dict(zip(JOURNALED, _journaled_of(process), strict=True)),
            "ran_before": process.ran_before_owner(owner),
            "excluded": dict(process.excluded),
            "failed_on": process.failed_on and to_plain(process.failed_on),
            "amended": pending is None, "limits_amended": pending is None or not pending.limits,
        },
    )  # fmt: skip


def migration_intent(tables: Tables, migration: Migration) -> Intent:
    """Return the progress of a migration."""
    numbers = sorted(tables.processes[migration.process].instances)
    stopping = [number for number in numbers if tables.instances[number].stopping]
    return Intent("migration", migration.process, _migration(tables, migration, stopping))


def _migration(tables: Tables, migration: Migration, stopping: Sequence[int]) -> dict[str, Any]:
    at = moment(tables.boot, migration.started)
    return {**migration_to_dict(migration, stopping), "at": at}


def moment(boot: str, at: float) -> list[str | float]:
    """Return a time of the master's clock as JSON values: the id of the boot, and the time."""
    return [boot, at] if isfinite(at) else []


def application_intent(application: Application) -> Intent:
    """Return the desired version and the tasks of an application."""
    return Intent("application", application.name, application_to_dict(application))


def version_intent(application: str, number: int, version: Version | None) -> Intent:
    """Return a version of an application; None: it is removed."""
    plain = None if version is None else version_to_dict(version)
    return Intent("version", key_of(application, number), plain)


def modes_intent(modes: Modes) -> Intent:
    """Return which mode is in force, and the progress of a switch."""
    return Intent("cluster", "modes", modes_to_dict(modes))


def mode_intent(name: str, mode: Mode | None) -> Intent:
    """Return a mode; None: it is removed."""
    return Intent("mode", name, None if mode is None else mode_to_dict(mode))
