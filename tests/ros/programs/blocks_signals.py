"""A program of `benchmarks.handoff_nodes` that blocks SIGINT and SIGTERM."""

from __future__ import annotations

import signal
import sys

from benchmarks import handoff_nodes

# Blocked, not ignored, because rclpy installs its own handlers.
signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT, signal.SIGTERM])
handoff_nodes.main(sys.argv)
