"""State of the modes: those that are known, the one in force, and a switch between two."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import inf
from typing import Any, Final

from rosrm.core.master.state.backoff import Backoff
from rosrm.model.codec import fields_from_plain, fields_to_plain, from_plain, to_plain
from rosrm.model.modes import Mode
from rosrm.model.requester import Requester


@dataclass(slots=True)
class Modes:
    """The modes of a cluster.

    Attributes:
        known: by name, in the order of their file.
        loaded_by: operator that loaded them, on whose behalf a condition puts one into force.
        wanted: name of the mode in force, or that is being reached; "": none.
        reached: name of the mode that was in force last, to which a switch that fails returns; "":
            none was.
        versions: application of the wanted mode to the number of its version, during a switch.
        switching: the applications of the wanted mode are not as desired yet.
        began: start of the switch by this master's clock; -inf: before this master started.
        fault: mode to the reason why it was left or not reached.
        met: modes whose condition holds; it puts a mode into force only when it begins to hold.
        retries: modes whose condition holds, and which could not be reached yet, to the back-off of
            the next try; any switch ends these tries.
    """

    known: dict[str, Mode] = field(default_factory=dict)
    loaded_by: Requester = Requester()  # noqa: RUF009 - immutable
    wanted: str = ""
    reached: str = ""
    versions: dict[str, int] = field(default_factory=dict)
    switching: bool = False
    began: float = -inf
    fault: dict[str, str] = field(default_factory=dict)
    met: list[str] = field(default_factory=list)
    retries: dict[str, Backoff] = field(default_factory=dict)

    @property
    def mode(self) -> Mode | None:
        """Return the mode in force, or that is being reached; None: there is none."""
        return self.known.get(self.wanted)


_JOURNALED: Final = (
    "loaded_by", "wanted", "reached", "versions", "switching", "fault", "met",
)  # fmt: skip


def modes_to_dict(modes: Modes) -> dict[str, Any]:
    """Return the state without the modes as JSON."""
    return {**fields_to_plain(modes, _JOURNALED), "order": list(modes.known)}


def restored_modes(progress: Mapping[str, Any], known: Mapping[str, Mapping[str, Any]]) -> Modes:
    """Return the state from the journal.

    Args:
        progress: result of `modes_to_dict`; empty: no modes were loaded.
        known: name of each mode to its JSON.
    """
    if not progress:
        return Modes()
    if "former" in progress:  # in older journals
        reached = progress["former"] or progress["wanted"]
        progress = {"reached": reached, **progress}
    modes = Modes(**fields_from_plain(Modes, progress, _JOURNALED))
    modes.known = {name: from_plain(Mode, known[name]) for name in progress["order"]}
    return modes


def mode_to_dict(mode: Mode) -> dict[str, Any]:
    """Return a mode as JSON."""
    plain: dict[str, Any] = to_plain(mode)
    return plain
