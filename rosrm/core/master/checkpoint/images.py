"""Checkpoint images: ownership of the name, and removal of unwanted images.

===========================  ===================================================================
process                      its image
===========================  ===================================================================
checkpointed                 owns the name, also while its host is lost, closed or switched off
restored                     loses the name to the restored instance at the commit
cancelled or restarted       is removed once its host is up; until then the removal is an intent
===========================  ===================================================================
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

from rosrm.core.master import events as happened
from rosrm.core.master.events import OrderOutcome
from rosrm.core.master.master_state import MasterState
from rosrm.core.master.state.images import UnwantedImage
from rosrm.core.master.state.pending_orders import ImageRemoval
from rosrm.core.master.state.process import Image, Process, ProcessPhase
from rosrm.model.codec import fields_from_plain, fields_to_plain
from rosrm.model.event_kinds import EventKind
from rosrm.model.orders import RunExecutor
from rosrm.model.records import Intent

#: Time-out of a removal, and first and longest delay before its retry; seconds.
_PATIENCE: Final = 30.0
_ASK_AGAIN: Final = 60.0
_LONGEST_WAIT: Final = 3600.0
#: Key of the unwanted images in the journal's table "cluster".
_KEY: Final = "unwanted_images"
#: Fields of an unwanted image that are journaled.
_JOURNALED: Final = ("process", "host", "drop", "numbers")


# --- of a process -----------------------------------------------------------------------------


def set_image(state: MasterState, process: Process, image: Image | None) -> None:
    """Set the image that owns the name of a process; None: no image owns it."""
    process.image = image
    if image is None:
        state.images.of.discard(process.name)
    else:
        state.images.of.add(process.name)


def note_checkpointed(state: MasterState, process: Process, now: float, trouble: str = "") -> None:
    """Set a process to checkpointed; `trouble`: why the last restore failed."""
    state.set_phase(process, ProcessPhase.CHECKPOINTED, now, trouble)
    if process.image is not None:  # the wall clock may have been set back
        process.since = now - max(0.0, state.wall - process.image.made_at)


def why_away(state: MasterState, image: Image) -> str:
    """Return why the host of an image is not available; "" if it is up."""
    host = state.hosts.by_name.get(image.host)
    return "is not known" if host is None else state.hosts.condition_of(host).words()


def reason_of(state: MasterState, process: Process) -> str:
    """Return the host and condition of a process's image, or else the reason of its phase."""
    image = process.image
    if image is None or process.phase is not ProcessPhase.CHECKPOINTED:
        return process.reason
    away = why_away(state, image)
    where = f"its image is on {image.host}" + (f", which {away}" if away else "")
    return f"{where}; {process.reason}" if process.reason else where


# --- removal of unwanted images ---------------------------------------------------------------


def cancel(state: MasterState, process: Process, now: float, *numbers: int) -> None:
    """Cancel a checkpointed process; the arguments are those of `drop`."""
    drop(state, process, *numbers)
    state.set_phase(process, ProcessPhase.CANCELLED, now)
    message = f"{process.name} cancelled; its image is removed"
    state.record(now, EventKind.CANCELLED, message, process=process.name)


def drop(state: MasterState, process: Process, *numbers: int) -> None:
    """Detach the image of a process, if it has one, and remove it from its host.

    `numbers`: further instance numbers under which the host may have stored the image.
    """
    image = process.image
    if image is not None:
        set_image(state, process, None)
        process.ended_on = image.host
        remove(state, process.name, image.host, image.drop, image.number, *numbers)


def remove(
    state: MasterState, process: str, host: str, drop: str, number: int, *numbers: int
) -> None:
    """Remove an image once its host is up; the arguments are those of `UnwantedImage`."""
    state.images.unwanted[number] = UnwantedImage(process, host, drop, (number, *numbers))
    _save(state)


def review(state: MasterState, now: float) -> None:
    """Order hosts that are up to remove unwanted images."""
    for number, one in state.images.unwanted.items():
        host = state.hosts.up(one.host)
        if host is not None and now >= one.backoff.until:
            arguments = {"process": one.process, "numbers": list(one.numbers)}
            removal = RunExecutor(one.drop, arguments, _PATIENCE)
            one.order = state.send(host, removal, ImageRemoval(number))
            one.backoff.until = now + _PATIENCE + _ASK_AGAIN


def note_answer(state: MasterState, number: int, event: happened.OrderAnswered, now: float) -> None:
    """Note the answer of a host to the order to remove an image."""
    one = state.images.unwanted.get(number)
    if one is None or one.order != event.order:
        return
    one.order = None
    if event.outcome in (OrderOutcome.ACCEPTED, OrderOutcome.BAD_RESULT):  # the executor ran
        del state.images.unwanted[number]
        state.record(
            now, EventKind.IMAGE_REMOVED, f"the image of {one.process} was removed from {one.host}",
            process=one.process, host=one.host, facts={"number": number},
        )  # fmt: skip
        _save(state)
        return
    one.backoff.note(now, _ASK_AGAIN, _LONGEST_WAIT)
    state.record(
        now, EventKind.IMAGE_LEFT,
        f"the image of {one.process} was not removed from {one.host}: {event.reason}; retrying",
        process=one.process, host=one.host, facts={"number": number},
    )  # fmt: skip


def _save(state: MasterState) -> None:
    unwanted = {
        str(number): fields_to_plain(one, _JOURNALED)
        for number, one in state.images.unwanted.items()
    }
    state.emit(Intent("cluster", _KEY, unwanted or None))


def restore(state: MasterState, cluster: Mapping[str, Mapping[str, Any]]) -> None:
    """Restore the unwanted images from the journal's table `cluster`."""
    for number, one in cluster.get(_KEY, {}).items():
        known = fields_from_plain(UnwantedImage, one, _JOURNALED)
        state.images.unwanted[int(number)] = UnwantedImage(**known)
