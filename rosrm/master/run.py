"""Starts the master's runtime from settings that were checked before: `rosrm master` executes this.

It imports neither pydantic nor typer nor rich: the memory of a master is budgeted.
"""

# ruff: noqa: E402 - Ctrl-C must end us without a traceback also while the rest is being imported
from __future__ import annotations

import signal

signal.signal(signal.SIGINT, signal.SIG_DFL)

import logging
import sys

from rosrm.config.settings import ClusterConfig
from rosrm.errors import RosrmError
from rosrm.handover import take_over
from rosrm.master.policy_guard import GuardedPolicy
from rosrm.master.runtime import MasterRuntime
from rosrm.registry import Registry


def main() -> int:
    """Read the settings from an inherited file descriptor and serve; returns the exit code."""
    handover = take_over(sys.argv[1:])
    logging.basicConfig(
        level=logging.INFO, stream=sys.stderr, format="%(asctime)s %(name)s: %(message)s",
        datefmt="%H:%M:%S",
    )  # fmt: skip
    config = ClusterConfig.from_json(handover.settings)
    try:
        return _serve(config, Registry.load(handover.plugins))
    except RosrmError as error:
        sys.stderr.write(f"rosrm master: {error}\n")
        return error.exit_code


def _serve(config: ClusterConfig, registry: Registry) -> int:
    name = config.scoring.policy or "weighted"
    policy = GuardedPolicy(name, registry.scoring(name, config.scoring.options))
    strategies = registry.migrations(config.migration.strategies)
    registry.checkpoint(config.checkpoint.policy, config.checkpoint.options)
    rows = registry.rows("scoring", "migration", "checkpoint")
    return MasterRuntime(config, policy, strategies, rows).run()


if __name__ == "__main__":
    sys.exit(main())
