"""Identity of a process started by rosrm, from its environment."""

from __future__ import annotations

import base64

import pytest

from rosrm.node.identity import NodeIdentity, identity_from, made_for, own_identity

FULL = {
    "ROSRM_INSTANCE": "robot/p#12",
    "ROSRM_NODE": "/ns/p",
    "ROSRM_STATE_CONFIG": "/rosrm/state_config",
    "ROSRM_MASTER": "lab",
    "ROSRM_EPOCH": "4",
}


def test_the_environment_identifies_a_process():
    """A process whose name has a slash has its identity, too."""
    identity = identity_from(FULL)
    assert identity == NodeIdentity("robot/p", 12, "/ns/p", "/rosrm/state_config", "lab", 4, False)


def test_a_shadow_is_marked_in_its_environment():
    """Only the exact value makes a shadow."""
    assert identity_from({**FULL, "ROSRM_SHADOW": "1"}).shadow
    assert not identity_from({**FULL, "ROSRM_SHADOW": ""}).shadow


def test_the_key_of_the_instance_is_not_shown():
    """Without a key the cluster has no security."""
    key = base64.b64encode(bytes(range(32))).decode()
    identity = identity_from({**FULL, "ROSRM_INSTANCE_KEY": key})
    assert identity.key == bytes(range(32))
    assert repr(identity.key)[2:-1] not in repr(identity)
    assert identity_from(FULL).key is None


@pytest.mark.parametrize("key", ["c2hvcnQ=", "no base64", "A" * 64])
def test_a_node_with_a_damaged_key_does_not_start(key):
    """Without a key the node would accept every message."""
    with pytest.raises(ValueError, match="base64"):
        identity_from({**FULL, "ROSRM_INSTANCE_KEY": key})


def test_the_key_of_the_instance_is_read_from_its_file(tmp_path):
    """A node whose file is missing or damaged does not start."""
    path = tmp_path / "key"
    variables = {**FULL, "ROSRM_INSTANCE_KEY_FILE": str(path)}
    with pytest.raises(ValueError, match="cannot be read"):
        identity_from(variables)
    for content in (b"", b"c2hvcnQ=", b"\xff" * 44, b"A" * 10_000):
        path.write_bytes(content)
        with pytest.raises(ValueError, match=r"base64|cannot be read"):
            identity_from(variables)
    path.write_bytes(base64.b64encode(bytes(range(32))))
    assert identity_from(variables).key == bytes(range(32))


@pytest.mark.parametrize("missing", ["ROSRM_INSTANCE", "ROSRM_STATE_CONFIG"])
def test_without_rosrm_there_is_no_identity(missing):
    """The node is then a plain rclpy node."""
    assert identity_from({**FULL, missing: ""}) is None
    assert identity_from({}) is None


@pytest.mark.parametrize(
    ("content", "epoch"),
    [("00000000000000000007\n", 7), ("", None), ("seven", None), ("9" * 20 + "junk", 10**20 - 1)],
)
def test_the_epoch_that_the_slave_knows_is_read_from_its_file(tmp_path, content, epoch):
    file = tmp_path / "epoch"
    file.write_text(content)
    assert identity_from({**FULL, "ROSRM_EPOCH_FILE": str(file)}).registered_epoch() == epoch


def test_without_a_file_the_epoch_of_the_slave_is_not_known(tmp_path):
    """A slave of an earlier release names none."""
    assert identity_from(FULL).registered_epoch() is None
    missing = str(tmp_path / "epoch")
    assert identity_from({**FULL, "ROSRM_EPOCH_FILE": missing}).registered_epoch() is None


def test_the_topics_of_rosrm_are_beside_the_masters():
    assert identity_from(FULL).namespace == "/rosrm"
    assert identity_from({**FULL, "ROSRM_STATE_CONFIG": "/a/b/state_config"}).namespace == "/a/b"


def test_a_node_in_a_container_has_the_identity_of_its_component(monkeypatch):
    """A component that is no process has none, although its container is a process of rosrm."""
    monkeypatch.setenv("ROSRM_INSTANCE", "box#1")
    monkeypatch.setenv("ROSRM_STATE_CONFIG", "/rosrm/state_config")
    with made_for(FULL):
        assert own_identity() == identity_from(FULL)
    with made_for({}):
        assert own_identity() is None
    own = own_identity()
    assert own is not None
    assert own.process == "box"
