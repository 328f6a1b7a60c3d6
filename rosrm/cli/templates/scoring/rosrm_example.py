"""A scoring policy for rosrm: of the hosts that fit, the one with the lowest score is chosen."""

from dataclasses import dataclass

from rosrm import Fraction, HostView, ProcessView, Scores, ScoringOffer, hookimpl


@dataclass(frozen=True)
class ExampleOptions:
    """Options of the policy in cluster.yaml.

    Attributes:
        most: used part of the memory above which a host is vetoed.
    """

    most: Fraction = 0.9


class ExamplePolicy:
    """Prefers the host with the smallest used part of its memory."""

    def __init__(self, options: ExampleOptions) -> None:
        self._most = options.most

    def score(self, hosts: HostView, process: ProcessView) -> Scores:
        """Return one score for each host; each depends on that host alone."""
        memory = hosts.column("memory", missing=1.0)
        return Scores(
            value=memory,
            veto=memory > self._most,
            veto_reason=lambda row: f"memory {memory[row]:.0%} used, over {self._most:.0%}",
            reason=lambda row: f"memory {memory[row]:.0%} used",
        )


@hookimpl
def register_scoring_policies() -> list[ScoringOffer]:
    """Offer the policy by the name with which cluster.yaml chooses it."""
    return [
        ScoringOffer(
            name="example",
            create=ExamplePolicy,
            options=ExampleOptions,
            summary="the host with the smallest used part of its memory",
        )
    ]
