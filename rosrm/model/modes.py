"""Values of modes: named sets of applications, of which one is in force."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from rosrm.model.applications import Target
from rosrm.model.values import EMPTY
from rosrm.wording import duration


@dataclass(frozen=True, slots=True)
class Trigger:
    """Condition that puts a mode into force; without a host and a resource there is none.

    Attributes:
        host_lost: name of a host that is lost.
        over_limit: resource of which a host is over its limit.
        lasts: seconds for which it must be.
    """

    host_lost: str = ""
    over_limit: str = ""
    lasts: float = 0.0

    def __str__(self) -> str:
        if self.host_lost:
            return f"{self.host_lost} is lost"
        if self.over_limit:
            return f"a host is over its limit of {self.over_limit} for {duration(self.lasts)}"
        return ""


@dataclass(frozen=True, slots=True)
class Mode:
    """A set of applications, with limits and weights that apply while the mode is in force.

    Attributes:
        targets: the desired applications, with the parameters of the mode.
        limits: resource to the highest fraction of it that any host may use.
        weights: resource to its weight in the scoring policies; empty: the weights of the cluster.
        when: condition that puts the mode into force.
        digest: digest of all this, by which a client tells two modes of one name apart; the master
            computes it when the mode is loaded.
    """

    name: str
    targets: tuple[Target, ...]
    limits: Mapping[str, float] = field(default_factory=lambda: EMPTY)
    weights: Mapping[str, float] = field(default_factory=lambda: EMPTY)
    when: Trigger = Trigger()
    digest: str = ""

    @property
    def applications(self) -> tuple[str, ...]:
        """Return the names of its applications."""
        return tuple(target.application for target in self.targets)


@dataclass(frozen=True, slots=True)
class ModeRow:
    """One mode, as it is listed.

    Attributes:
        name: of the mode.
        state: "in force"; "switching": its applications are not as desired yet; "": neither.
        applications: names of its applications.
        limits: resource to the highest fraction, 0 to 1, that any host may use in this mode.
        weights: resource to its weight, 0 to 1, in the scoring policies; empty: the weights of the
            cluster.
        when: condition that puts it into force; "": none.
        reason: why it was left, or not reached, when this was tried last; or which of its
            applications have changed since it came into force.
        digest: digest of its contents; another one: the mode was loaded with other contents since.
    """

    name: str
    state: str
    applications: tuple[str, ...]
    limits: Mapping[str, float] = field(default_factory=lambda: EMPTY)
    weights: Mapping[str, float] = field(default_factory=lambda: EMPTY)
    when: str = ""
    reason: str = ""
    digest: str = ""
