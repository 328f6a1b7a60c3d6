"""State of the applications: kept versions, the desired one, and the open tasks towards it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import inf
from typing import Any, Final

from rosrm.core.master.state.backoff import Backoff
from rosrm.model.applications import RolloutPolicy
from rosrm.model.codec import fields_from_plain, fields_to_plain, from_plain
from rosrm.model.lazy import Plain
from rosrm.model.values import ProcessSpec


@dataclass(frozen=True, slots=True)
class Version:
    """One desired state of an application.

    Attributes:
        specs: name of each process to its spec, with the cluster's defaults.
        defaulted: name of a process to the paths of the fields that have the cluster's defaults.
        wall: unix time of the request.
        by: principal that requested it.
        note: origin of the version, if it is not a file.
        given_up: why the master returned to another version; "": it did not.
    """

    number: int
    specs: Mapping[str, ProcessSpec]
    defaulted: Mapping[str, tuple[str, ...]]
    rollout: RolloutPolicy
    wall: float
    by: str
    note: str = ""
    given_up: str = ""


@dataclass(slots=True)
class Task:
    """Work on one process that is not yet as its application wants it.

    Attributes:
        replaces: a live process is replaced; few are at the same time.
        begun: the action on the process has begun, or the process was cancelled before.
        fault: why its replacement failed; "": it did not.
        reason: why it is not done yet.
        run: number of the owning instance and its restarts when the process began to run well.
        well_since: start of that run by this master's clock; inf: it does not run well.
        awaits_host: the process finds no host for now.
        awaits_since: start of that wait by this master's clock; inf: it finds one, or runs.
    """

    replaces: bool = False
    begun: bool = False
    fault: str = ""
    reason: str = ""
    run: tuple[int, int] = (0, 0)
    well_since: float = inf
    awaits_host: bool = False
    awaits_since: float = inf


@dataclass(slots=True)
class Application:
    """One application.

    Attributes:
        by_operator: its owner was an operator when it made the application.
        versions: kept versions by number, in order.
        wanted: number of the desired version; 0: none, the application is cancelled.
        former: number of the version to which a failed replacement returns; 0: none.
        returning: the desired version was reached before: a newer one has failed, or a process that
            runs with another one is replaced.
        paused: why the replacement stopped halfway; "": it did not.
        tasks: name of each process that is not yet as desired.
        behind: name of each process that no task replaces any more, because its replacement has
            failed and no other version returns, to the back-off of the next try.
        newest: highest number of a version.
    """

    name: str
    principal: str
    by_operator: bool = False
    versions: dict[int, Version] = field(default_factory=dict)
    wanted: int = 0
    former: int = 0
    returning: bool = False
    paused: str = ""
    tasks: dict[str, Task] = field(default_factory=dict)
    behind: dict[str, Backoff] = field(default_factory=dict)
    newest: int = 0

    @property
    def version(self) -> Version | None:
        """Return the desired version; None: the application is cancelled."""
        return self.versions.get(self.wanted)

    @property
    def specs(self) -> Mapping[str, ProcessSpec]:
        """Return the desired processes."""
        version = self.version
        return {} if version is None else version.specs

    @property
    def reached(self) -> int:
        """Return the number of the version to which a failure of another one would lead back."""
        unreached = bool(self.tasks) and not self.returning
        return self.former if unreached else self.wanted

    def note_cancelled(self, name: str) -> bool:
        """Note that a process is cancelled before the action on it; return True if that is news.

        The cancellation is newer than the request, so the process does not start again.
        """
        task = self.tasks.get(name)
        if task is None or task.begun:
            return False
        task.begun = True
        return True

    def reopen(self, name: str) -> None:
        """Note that a process runs with another spec than the desired one, and is replaced.

        If no other work is open, the process returns to a version that was reached before.
        """
        if name in self.specs:
            self.returning = self.returning or not self.tasks
            self.tasks[name] = Task(replaces=True)

    def keep(self, number: int) -> list[int]:
        """Drop the oldest versions beyond a number; return the numbers of the dropped ones."""
        needed = {self.wanted, self.former, self.newest}
        spare = [one for one in self.versions if one not in needed]
        dropped = spare[: max(0, len(self.versions) - number)]
        for one in dropped:
            del self.versions[one]
        return dropped


#: Fields that are journaled unchanged.
_APPLICATION: Final = (
    "principal", "by_operator", "wanted", "former", "returning", "paused", "newest",
)  # fmt: skip
_TASK: Final = ("replaces", "begun", "fault")
_VERSION: Final = ("number", "defaulted", "rollout", "wall", "by", "note", "given_up")


def application_to_dict(application: Application) -> dict[str, Any]:
    """Return an application without its versions as JSON."""
    tasks = {name: fields_to_plain(task, _TASK) for name, task in application.tasks.items()}
    own = fields_to_plain(application, _APPLICATION)
    return {**own, "tasks": tasks, "behind": list(application.behind)}


def application_from_dict(name: str, item: Mapping[str, Any]) -> Application:
    """Return the inverse of `application_to_dict`."""
    restored = Application(name, **fields_from_plain(Application, item, _APPLICATION))
    restored.tasks = {
        name: Task(**fields_from_plain(Task, plain, _TASK)) for name, plain in item["tasks"].items()
    }
    restored.behind = {name: Backoff() for name in item.get("behind", ())}  # absent in older ones
    return restored


def key_of(name: str, number: int) -> str:
    """Return the key of a version in the journal."""
    return f"{number} {name}"


def version_to_dict(version: Version) -> dict[str, Any]:
    """Return a version as JSON."""
    specs = [Plain(spec) for spec in version.specs.values()]
    return {**fields_to_plain(version, _VERSION), "specs": specs}


def version_from_dict(item: Mapping[str, Any]) -> Version:
    """Return the inverse of `version_to_dict`."""
    specs = [from_plain(ProcessSpec, plain) for plain in item["specs"]]
    return Version(
        specs={spec.name: spec for spec in specs}, **fields_from_plain(Version, item, _VERSION)
    )
