"""A master that gives each process with snapshots a key, which the cluster's secret determines."""

from __future__ import annotations

import sys
from functools import partial

from rosrm.keys.derivation import derived
from rosrm.master.__main__ import serve
from rosrm.ros.master import endpoint
from rosrm.runtime.bootstrap import run

SECRET = b"secret of a cluster for the test"


def state_key(process: str) -> bytes:
    return derived(SECRET, "state", process)


if __name__ == "__main__":
    endpoint.HostLinks = partial(endpoint.HostLinks, state_key=state_key)
    sys.exit(run("master", serve))
