"""Clusters that things are done to."""

from tests.ros.conftest import make_cluster, make_shared

__all__ = ["make_cluster", "make_shared"]
