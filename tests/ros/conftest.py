"""Clusters of real masters, slaves and processes; a ROS domain of its own for each."""

from __future__ import annotations

import pytest

from tests.ros.clusters import STEADY, clusters


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
