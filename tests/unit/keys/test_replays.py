"""Recorded messages and copied processes, which the seal of a message does not detect.

A connection with keys of its own for each session refuses all of this.
"""

from __future__ import annotations

import os
import pickle

import pytest

from rosrm.keys.links import KeyedLink, SealedMessage
from rosrm.keys.sealing import RUN_BYTES, Direction, channel_of

KEY = bytes(range(32))
CHANNEL = channel_of("/rosrm/list", "t")
on_dds = pytest.mark.xfail(reason="the control plane is on DDS: each message is sealed alone")


def user() -> KeyedLink:
    return KeyedLink(KEY, os.urandom(RUN_BYTES), Direction.TO_MASTER, Direction.FROM_MASTER)


@on_dds
def test_a_recorded_request_is_never_accepted_again() -> None:
    """The user may have run many commands since; each has a run of its own."""
    master = KeyedLink(KEY, bytes(RUN_BYTES), Direction.FROM_MASTER, Direction.TO_MASTER)
    recorded = user().seal(CHANNEL, b"list", b"run")
    assert master.open(CHANNEL, recorded, b"run") == b"list"
    for _ in range(300):
        master.open(CHANNEL, user().seal(CHANNEL, b"list", b"run"), b"run")
    assert master.open(CHANNEL, recorded, b"run") is None


@on_dds
def test_a_copied_process_repeats_no_nonce() -> None:
    """A fork, a checkpoint or a snapshot of the machine continues with the same counter and key."""
    link = user()
    link.seal(CHANNEL, b"before", b"run")
    reader, writer = os.pipe()
    child = os.fork()
    if not child:
        os.write(writer, pickle.dumps(tuple(link.seal(CHANNEL, b"child", b"run"))))
        os._exit(0)
    os.waitpid(child, 0)
    os.close(writer)
    with os.fdopen(reader, "rb") as sent:
        copied = SealedMessage(*pickle.loads(sent.read()))
    own = link.seal(CHANNEL, b"parent", b"run")
    assert (own.run, own.counter) != (copied.run, copied.counter)
