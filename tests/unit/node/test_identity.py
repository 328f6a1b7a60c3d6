"""Identity of a process started by rosrm, from its environment."""

from __future__ import annotations

import pytest

from rosrm.node.identity import NodeIdentity, identity_from

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


@pytest.mark.parametrize("missing", ["ROSRM_INSTANCE", "ROSRM_STATE_CONFIG"])
def test_without_rosrm_there_is_no_identity(missing):
    """The node is then a plain rclpy node."""
    assert identity_from({**FULL, missing: ""}) is None
    assert identity_from({}) is None
