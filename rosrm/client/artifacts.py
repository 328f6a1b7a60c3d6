"""Sending of the contents of artifacts to the master, before their processes are submitted."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Final, Protocol

from rosrm import clocks
from rosrm.artifacts.pack import Archive, changed
from rosrm.client.retrying import Notify
from rosrm.errors import Refused
from rosrm.model.artifacts import Artifact
from rosrm.model.values import ProcessSpec
from rosrm.wording import size as sized

#: Most bytes of one part.
_PART: Final = 256 << 10
#: Seconds between two sentences on the progress.
_NOTIFY_PERIOD: Final = 5.0
#: Most times that a part is sent again because the master lost the former ones, as by a restart.
_MOST_RETRIES: Final = 5
#: Seconds before a request that a busy master refused is repeated, and most repetitions.
_BUSY: Final = 1.0
_MOST_BUSY: Final = 60


class _Master(Protocol):
    def store_artifact(self, digest: str, size: int, offset: int, data: bytes = b"") -> int:
        """Send a part of an artifact; see `MasterClient`."""


def with_digests(
    specs: Sequence[ProcessSpec],
) -> tuple[list[ProcessSpec], dict[str, Archive]]:
    """Return specs with the digests of their artifacts, and the archive of each path.

    Raises:
        ConfigError: an artifact cannot be read.
    """
    archives: dict[str, Archive] = {}

    def filled(one: Artifact) -> Artifact:
        if not one.source:
            return one
        if one.source not in archives:
            archives[one.source] = Archive(one.source)
        archive = archives[one.source]
        return replace(one, digest=archive.digest, size=archive.size)

    done = [replace(spec, artifacts=tuple(map(filled, spec.artifacts))) for spec in specs]
    return done, archives


def send_artifacts(
    master: _Master, specs: Sequence[ProcessSpec], notify: Notify
) -> list[ProcessSpec]:
    """Send the contents that the master does not have, and return the specs with the digests.

    Args:
        notify: takes a sentence on the progress, if sending takes long.

    Raises:
        ConfigError: an artifact cannot be read.
        Refused: the master has no room, or the contents changed while they were sent.
        NoMaster: the master does not answer.
    """
    done, archives = with_digests(specs)
    for source, archive in archives.items():
        try:
            _send(master, source, archive, notify)
        except Refused as refusal:
            if refusal.code == "changed":
                raise changed(source) from None
            raise Refused(f"artifact {source}: {refusal}", refusal.code) from None
    return done


def _send(master: _Master, source: str, archive: Archive, notify: Notify) -> None:
    offset, notified, retries = _stored(master, archive), clocks.boot_time(), 0
    while offset < archive.size:
        data = archive.part(offset, _PART)
        answered = _stored(master, archive, offset, data)
        if answered == offset + len(data):
            offset = answered
        elif (retries := retries + 1) > _MOST_RETRIES:
            raise Refused("the master has lost what it had received; submit again", "changed")
        else:
            offset = _stored(master, archive)
        if clocks.boot_time() - notified >= _NOTIFY_PERIOD:
            notified = clocks.boot_time()
            notify(f"sends {source} to the master: {sized(offset)} of {sized(archive.size)}")


def _stored(master: _Master, archive: Archive, offset: int = 0, data: bytes = b"") -> int:
    """Send a part as soon as the master is not busy; return the offset of the next one.

    Without data the master only returns the offset from which it needs the archive.
    """
    for _ in range(_MOST_BUSY):
        try:
            return master.store_artifact(archive.digest, archive.size, offset, data)
        except Refused as refusal:
            if refusal.code != "busy":
                raise
        time.sleep(_BUSY)
    return master.store_artifact(archive.digest, archive.size, offset, data)
