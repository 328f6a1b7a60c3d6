"""Clusters of real masters, slaves and processes; a ROS domain of its own for each."""

from __future__ import annotations

from contextlib import closing

import pytest

from rosrm.testing.loopback import enter_private_network
from tests.ros.clusters import STEADY, clusters
from tests.ros.nodes import Stage
from tests.ros.portable_kit import Ear


@pytest.fixture(scope="session", autouse=True)
def private_network():
    """Where it is allowed: nobody else is heard, and who is killed leaves nothing to the next."""
    enter_private_network()


@pytest.fixture
def make_cluster(tmp_path_factory):
    """Makes clusters for one test."""
    with clusters(lambda: tmp_path_factory.mktemp("c")) as make:
        yield make


@pytest.fixture(scope="module")
def make_shared(tmp_path_factory):
    """Makes clusters that the tests of a module share."""
    with clusters(lambda: tmp_path_factory.mktemp("c"), liveness=STEADY) as make:
        yield make


@pytest.fixture
def ear(cluster):
    """Hears the portable counters in the cluster of a module."""
    with closing(Ear(cluster.domain)) as ear:
        yield ear


@pytest.fixture
def stage():
    """A ROS context in a domain of its own, for nodes that think they are instances."""
    stage = Stage()
    yield stage
    stage.close()
