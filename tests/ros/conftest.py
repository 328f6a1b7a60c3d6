"""Fixtures of clusters with real masters, slaves and processes, each in its own ROS domain."""

from __future__ import annotations

from contextlib import closing

import pytest

from benchmarks.browser import CHROMIUM, MISSING, browser
from rosrm.node import Node
from rosrm.testing.loopback import enter_private_network
from tests.cpp.core_library import VARIABLE
from tests.cpp.cpp_node import Node as CppNode
from tests.ros.browser_kit import BROWSER_PATIENCE
from tests.ros.clusters import STEADY, clusters
from tests.ros.nodes import KEYS, Counting, Serving, Stage
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


@pytest.fixture(scope="module")
def chromium():
    """Yield a browser; skip the tests where there is none."""
    if CHROMIUM is None:
        pytest.skip(MISSING)
    with browser(BROWSER_PATIENCE) as one:
        yield one


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


@pytest.fixture
def cpp_node_class(cpp_core, monkeypatch):
    """Return the base class of nodes of rosrm_node_cpp."""
    monkeypatch.setenv(VARIABLE, str(cpp_core))
    return CppNode


@pytest.fixture(params=["rosrm.node", "rosrm_node_cpp"])
def implementation(request):
    """Return the base class of migratable nodes of each implementation of the handoff protocol."""
    return Node if request.param == "rosrm.node" else request.getfixturevalue("cpp_node_class")


@pytest.fixture
def counter(implementation):
    """Return the class of a counter."""
    return type("Counter", (Counting, implementation), {})


@pytest.fixture
def server(implementation):
    """Return the class of a counter with a service."""
    return type("Server", (Serving, implementation), {})
