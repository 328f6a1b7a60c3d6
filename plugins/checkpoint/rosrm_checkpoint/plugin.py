"""Plugin hook that registers the checkpoint policies."""

from __future__ import annotations

from collections.abc import Sequence

from rosrm import CheckpointOffer, hookimpl
from rosrm_checkpoint.other_host import OtherHost, OtherHostOptions


@hookimpl
def register_checkpoint_policies() -> Sequence[CheckpointOffer]:
    """Offer `other-host`: replicas of a process's snapshot on hosts other than its own."""
    return [
        CheckpointOffer(
            name="other-host",
            create=OtherHost,
            options=OtherHostOptions,
            summary="the newest state of a process, on so many other hosts",
        )
    ]
