"""Seconds of three starts: `rosrm ps`, a slave until it has registered, a cluster of three hosts.

The cluster is that of `make demo` without its nodes: master and slaves are started together, and
the time ends when every host requests work. The slave joins a running cluster; its registration has
the time of the master's event. Each figure is a median. CPU seconds are those of one `rosrm ps`.
"""

from __future__ import annotations

import os
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.command import measure
from benchmarks.hosts import three_hosts
from benchmarks.machine import parser, print_report
from benchmarks.stopping import run
from rosrm.config.settings import HostConfig
from rosrm.model.rows import Listing
from rosrm.testing.local_cluster import LocalCluster

_TIMEOUT = 30.0


def main() -> None:
    """Measure and print one JSON object."""
    command_line = parser(__doc__)
    command_line.add_argument("--runs", type=int, default=10, help="clusters, e.g. 10 (default)")
    runs = command_line.parse_args().runs
    rows = [_round() for _ in range(runs)]
    cluster, slave, command, cpu = (float(one) for one in np.median(rows, axis=0))
    figures = {"ps_s": command, "ps_cpu_s": cpu, "slave_s": slave, "cluster_s": cluster}
    print_report("startup", figures, runs=runs)


def _round() -> tuple[float, float, float, float]:
    """Start a cluster, a slave, and the command twice, so that its files are cached.

    Returns:
        Seconds of the cluster, the slave and the command, and CPU seconds of the command.
    """
    hosts = three_hosts()
    with tempfile.TemporaryDirectory(prefix="rosrm-startup-") as folder:
        begun = time.monotonic()
        with LocalCluster(Path(folder), hosts=hosts) as cluster:
            up = time.monotonic() - begun
            slave = _start_slave(cluster, replace(hosts[0], host="host3"))
            environment = {**os.environ, **cluster.ros.environment()}
            measure(("ps",), environment)
            return up, slave, *measure(("ps",), environment)


def _start_slave(cluster: LocalCluster, host: HostConfig) -> float:
    """Start a slave, and return the seconds from its start to its registration."""
    begun = time.time()
    cluster.start_slave(host)

    def registered(view: Listing) -> bool:
        return any(row.description.name == host.host for row in view.hosts)

    cluster.wait_until(f"registration of {host.host}", registered, _TIMEOUT)
    events = cluster.client.list(events=True, host=host.host).events
    return next(one.wall_time for one in events if one.kind == "host_registered") - begun


if __name__ == "__main__":
    sys.exit(run("startup", main))
