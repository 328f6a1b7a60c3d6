"""A checkpoint policy for rosrm: places the replicas of the snapshots of stateful nodes."""

from dataclasses import dataclass

from rosrm import CheckpointChoice, CheckpointOffer, CheckpointView, PositiveSeconds, hookimpl


@dataclass(frozen=True)
class ExampleOptions:
    """Options of the policy in cluster.yaml.

    Attributes:
        every: shortest time between two transfers of a snapshot, in seconds.
    """

    every: PositiveSeconds = 5.0


class ExamplePolicy:
    """Replicates each snapshot to one other host, and stays with that host."""

    def __init__(self, options: ExampleOptions) -> None:
        self._every = options.every

    def choose(self, process: CheckpointView) -> CheckpointChoice:
        """Return the hosts of the replicas from now on; called about once a second."""
        others = sorted(process.hosts.keys() - {process.host})
        current = [name for name in process.replica_hosts if name in others]
        return CheckpointChoice(hosts=tuple((current + others)[:1]), every=self._every)


@hookimpl
def register_checkpoint_policies() -> list[CheckpointOffer]:
    """Offer the policy by the name with which cluster.yaml chooses it."""
    return [
        CheckpointOffer(
            name="example",
            create=ExamplePolicy,
            options=ExampleOptions,
            summary="one replica, on another host",
        )
    ]
