"""Requests for announcements, to a peer that does not announce itself again."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from contextlib import closing

import pytest
import rclpy
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from rosrm.model.ros_settings import RosSettings
from rosrm.ros.peer_announcements import request_announcements
from rosrm.testing.local_cluster import LocalCluster, claim_domain
from tests.waiting import PATIENCE, wait_until

#: A port of discovery that no participant of a test reaches: the 31st of its domain.
PORT = 7410 + 2 * 30
SILENT = """\
<profiles xmlns="http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles">
  <participant profile_name="silent" is_default_profile="true"><rtps><builtin><discovery_config>
    <initialAnnouncements><count>0</count></initialAnnouncements>
    <leaseDuration><sec>1000</sec></leaseDuration>
    <leaseAnnouncement><sec>900</sec></leaseAnnouncement>
  </discovery_config></builtin></rtps></participant>
</profiles>
"""
PEER = """\
import rclpy
rclpy.init()
rclpy.spin(rclpy.create_node("peer"))
"""


@pytest.fixture
def node():
    """Yield a node of this process, in a domain of its own."""
    domain, claim = claim_domain()
    context = rclpy.Context()
    with claim:
        rclpy.init(
            context=context, domain_id=domain, signal_handler_options=SignalHandlerOptions.NO
        )
        yield Node("here", context=context)
        context.try_shutdown()


@pytest.fixture
def peer(node, tmp_path):
    """Yield a process with a known node that will not announce itself again for 900 s."""
    profile = tmp_path / "silent.xml"
    profile.write_text(SILENT)
    domain = node.context.get_domain_id()
    added = {"FASTRTPS_DEFAULT_PROFILES_FILE": str(profile), "ROS_DOMAIN_ID": str(domain)}
    process = subprocess.Popen([sys.executable, "-c", PEER], env={**os.environ, **added})
    try:
        wait_until(lambda: "peer" in node.get_node_names(), "the peer is discovered")
        yield process
    finally:
        process.kill()
        process.wait(PATIENCE)


def test_a_starting_master_requests_announcements(tmp_path):
    """Slaves announce themselves every second; a restarted master must not wait for that."""
    domain, claim = claim_domain()
    cluster = LocalCluster(tmp_path, joining=RosSettings(domain, "localhost"))
    port = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    with claim, port, closing(cluster):
        port.bind(("127.0.0.1", PORT + 250 * domain))
        port.settimeout(PATIENCE)
        cluster.start_master()
        while port.recv(65536)[6:8] != bytes(2):  # the request has the vendor 0
            pass


def test_a_peer_announces_itself_again_on_request(node, peer):
    """The peer's announcement arrives at each port of discovery of the process that requests it."""
    domain = node.context.get_domain_id()
    with closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as port:
        port.bind(("", PORT + 250 * domain))
        port.settimeout(PATIENCE)
        request_announcements(domain, os.environ)
        sender = b""
        while sender != (peer.pid & 0xFFFF).to_bytes(2, "little"):
            packet = port.recv(65536)  # `node` announces itself, too
            assert packet.startswith(b"RTPS")
            sender = packet[12:14]
