"""A program of `benchmarks.handoff_nodes` that SIGINT and SIGTERM do not reach."""

from __future__ import annotations

import signal
import sys

from benchmarks import handoff_nodes

# Blocked, not ignored: rclpy sets handlers of its own.
signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT, signal.SIGTERM])
handoff_nodes.main(sys.argv)
