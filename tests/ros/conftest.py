"""Fixtures of clusters with real masters, slaves and processes, each in its own ROS domain."""

from __future__ import annotations

from contextlib import closing

import pytest

from rosrm.testing.loopback import enter_private_network
from tests.ros.clusters import STEADY, clusters
from tests.ros.nodes import KEYS, Stage
from tests.ros.portable_kit import Listener


@pytest.fixture(scope="session", autouse=True)
def private_network():
    """Enter a private network, if permitted: no foreign traffic, no shared memory left by kills."""
    enter_private_network()


@pytest.fixture
def make_cluster(tmp_path_factory):
    """Yield a factory of clusters for one test."""
    with clusters(lambda: tmp_path_factory.mktemp("c")) as make:
        yield make


@pytest.fixture(scope="module")
def make_shared(tmp_path_factory):
    """Yield a factory of clusters that the tests of a module share."""
    with clusters(lambda: tmp_path_factory.mktemp("c"), liveness=STEADY) as make:
        yield make


@pytest.fixture
def listener(cluster):
    """Yield a listener to the portable counters in the module's cluster."""
    with closing(Listener(cluster.domain)) as listener:
        yield listener


@pytest.fixture
def stage(request):
    """Yield a ROS context in its own domain, for nodes that run as if started by a slave.

    Its cluster has keys; the parameter None makes one without security.
    """
    stage = Stage(keys=getattr(request, "param", KEYS))
    yield stage
    stage.close()
