"""Keys of instances and handoffs."""

from __future__ import annotations

import pytest

from rosrm.keys.derivation import KEY_BYTES, derived
from rosrm.keys.handoffs import HandoffKeys, instance_key, new_link
from rosrm.keys.names import handoff_name, instance_name, named_instance
from rosrm.keys.sealing import Direction

SECRET, HOST = bytes(range(32)), bytes(range(32, 64))


def test_the_master_derives_the_key_that_the_slave_gives_to_a_node() -> None:
    """Each instance and each handoff has a key of its own; an unknown instance has none."""
    keys = HandoffKeys(lambda: SECRET, lambda process, _: HOST if process == "p" else None)
    assert keys.of_instance("p", 7) == instance_key(HOST, "p", 7)
    assert keys.of_instance("p", 7) == derived(HOST, "instance", "p", 7)
    assert keys.of_handoff("p", 8) == derived(SECRET, "handoff", "p", 8)
    assert keys.of_instance("q", 7) is None
    found = {keys.of_instance("p", 7), keys.of_instance("p", 8), keys.of_handoff("p", 8)}
    assert {len(key) for key in found} == {KEY_BYTES}
    assert len(found) == 3


@pytest.mark.parametrize("process", ["p", "a#1", "a:b", "instance:p#1"])
def test_a_name_tells_process_and_number(process: str) -> None:
    assert named_instance(instance_name(process, 2**64)) == (process, 2**64)


@pytest.mark.parametrize(
    "name", ["", "instance:", "instance:#1", "instance:p#", "instance:p#-1", "instance:p#²", "p#1"]
)
def test_other_texts_name_no_instance(name: str) -> None:
    assert named_instance(name) is None
    assert named_instance(handoff_name("p", 1)) is None


@pytest.mark.parametrize("key", [SECRET, None])
def test_a_new_link_begins_a_new_run(key: bytes | None) -> None:
    """Two links under one key never use one counter twice for one run."""
    links = [new_link(key, Direction.TO_PEER, Direction.TO_PEER) for _ in range(2)]
    first, second = (link.seal(bytes(16), b"x") for link in links)
    assert first.run != second.run
    assert links[0].open(bytes(16), second) == b"x"
