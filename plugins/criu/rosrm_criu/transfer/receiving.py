"""Fetch of an offered directory: read, verify and place it; on failure leave nothing."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Final

from rosrm.errors import TransferError
from rosrm.runtime.disk_space import room_for
from rosrm_criu.transfer.form import Fetched, Offer
from rosrm_criu.transfer.landing import Landing
from rosrm_criu.transfer.stream import Stream
from rosrm_criu.transfer.unpacking import unpack

if TYPE_CHECKING:
    from rosrm_criu.transfer.certificate import Identity

#: Bytes that a file may occupy beyond its content, rounded up.
_ROUNDING: Final = 4096


def receive(
    offer: Offer, target: Path, *, timeout: float, reserve: int, identity: Identity,
    before_placing: Callable[[], None],
) -> Fetched:  # fmt: skip
    """Fetch a directory.

    Args:
        offer: of the source.
        target: path of the new directory, which must not exist yet.
        timeout: seconds for the whole fetch.
        reserve: bytes that must stay free on the file system.
        identity: the one whose certificate the source knows.
        before_placing: called after complete verification, before the target appears.

    Raises:
        TransferError: the directory cannot be fetched completely; nothing of it is left.
    """
    began = time.monotonic()
    if identity.fingerprint != offer.to:
        raise TransferError("what is offered is for another destination than this one")
    with contextlib.closing(Landing(target)) as landing:
        landing.require(offer.length + offer.files * _ROUNDING, reserve)
        stream = Stream(offer, timeout=timeout, identity=identity)
        with contextlib.closing(stream):
            try:
                files = unpack(stream, landing.path)
            except OSError as error:
                raise TransferError(_unwritable(target, error)) from None
            checksum = stream.check()
            if files != offer.files:
                raise TransferError(f"{files} files came, {offer.files} were offered")
            before_placing()
            landing.become_target()
            stream.say_taken()
    return Fetched(
        address=stream.address,
        size=offer.size,
        files=files,
        received=stream.received,
        resumed=stream.resumed,
        seconds=time.monotonic() - began,
        checksum=checksum,
    )


def _unwritable(target: Path, error: OSError) -> str:
    room = room_for(target)
    return f"{target} cannot be written: {error.strerror}" + (f"; {room}" if room else "")
