"""Fixtures for clusters under fault injection."""

from tests.ros.conftest import make_cluster, make_shared, private_network

__all__ = ["make_cluster", "make_shared", "private_network"]
