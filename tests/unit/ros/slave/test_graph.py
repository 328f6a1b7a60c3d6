"""Graph lookup by GID: instances on different hosts may share a pid."""

from __future__ import annotations

import os
from dataclasses import dataclass

from rosrm.ros.slave.graph import GraphWatch

HERE, ELSEWHERE = b"\x11\x11", b"\x22\x22"


def gid(host: bytes, pid: int) -> bytes:
    """Return a GID as Fast DDS builds it: vendor, host, process, random part."""
    return b"\x01\x0f" + host + (pid & 0xFFFF).to_bytes(2, "little") + bytes(18)


@dataclass
class Info:
    node_name: str
    endpoint_gid: bytes
    node_namespace: str = "/"


class FakeNode:
    """Fake ROS graph of the slave's own node."""

    def __init__(self, *infos: Info) -> None:
        self.infos = infos

    def get_fully_qualified_name(self):
        return "/rosrm_slave_a"

    def get_publishers_info_by_topic(self, topic):
        return list(self.infos)


def test_the_slave_of_another_host_may_have_the_same_pid():
    """Virtual hosts and containers number their processes from 1 on."""
    own, other = gid(HERE, os.getpid()), gid(ELSEWHERE, os.getpid())
    node = FakeNode(
        Info("rosrm_slave_a", own), Info("rosrm_slave_b", other), Info("talker", gid(HERE, 44))
    )
    assert GraphWatch(node).sees("/talker", [44], frozenset())


def test_the_same_pid_on_another_host_is_another_process():
    """A node of the same name left on another host is not the instance started here."""
    node = FakeNode(
        Info("rosrm_slave_a", gid(HERE, os.getpid())), Info("talker", gid(ELSEWHERE, 44))
    )
    assert not GraphWatch(node).sees("/talker", [44], frozenset())
