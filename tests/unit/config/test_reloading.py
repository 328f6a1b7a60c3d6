"""Difference between two versions of settings: what applies now, and what needs a restart."""

from __future__ import annotations

from dataclasses import replace

from rosrm.config.reloading import OF_CLUSTER, OF_HOST, reloaded
from rosrm.config.settings import (
    ClusterConfig,
    HostConfig,
    LivenessSettings,
    MigrationSettings,
    QueueSettings,
    ScoringChoice,
)


def test_equal_settings_have_no_difference() -> None:
    """Nothing is changed, and nothing needs a restart."""
    read = reloaded(ClusterConfig(), ClusterConfig(), OF_CLUSTER)
    assert (read.config, read.changed, read.kept) == (ClusterConfig(), (), ())


def test_only_the_settings_that_need_no_restart_are_taken_over() -> None:
    """The others are named, and stay."""
    old = ClusterConfig()
    new = replace(
        old,
        queue=QueueSettings(backfill=True),
        migration=MigrationSettings(cooldown=7.0, strategies={"relaunch": {}}),
        liveness=LivenessSettings(lease=99.0),
        scoring=ScoringChoice(options={"weights": {"memory": 2.0}}),
    )
    read = reloaded(old, new, OF_CLUSTER)
    assert read.changed == ("scoring", "migration.cooldown", "queue")
    assert read.kept == ("migration.strategies", "liveness.lease")
    assert (read.config.migration.cooldown, read.config.queue.backfill) == (7.0, True)
    assert read.config.migration.strategies == old.migration.strategies
    assert read.config.liveness == old.liveness


def test_labels_and_limits_of_a_host_need_no_restart() -> None:
    """A limit that the file no longer names has its default again."""
    old = HostConfig("h", labels={"arm": "yes"}, limits={"memory": 0.5}, rate=10.0)
    new = HostConfig("h", labels={"arm": "no"}, limits={"cpu": 0.4}, rate=5.0)
    read = reloaded(old, new, OF_HOST)
    assert (read.changed, read.kept) == (("labels", "limits"), ("rate",))
    assert read.config.limits == {"memory": 0.8, "cpu": 0.4, "disk": 0.9}
    assert (read.config.labels, read.config.rate) == ({"arm": "no"}, 10.0)


def test_each_path_of_a_setting_that_needs_no_restart_exists() -> None:
    """A renamed setting must be renamed there, too."""
    for config, paths in ((ClusterConfig(), OF_CLUSTER), (HostConfig("h"), OF_HOST)):
        for path in paths:
            value: object = config
            for name in path.split("."):
                value = getattr(value, name)
