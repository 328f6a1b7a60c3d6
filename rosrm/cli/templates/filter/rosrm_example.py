"""A placement filter for rosrm: only hosts that pass may run a process."""

from dataclasses import dataclass

from rosrm import BoolArray, FilterOffer, HostView, PositiveCount, ProcessView, hookimpl


@dataclass(frozen=True)
class ExampleOptions:
    """Options of the filter in cluster.yaml.

    Attributes:
        most: number of processes from which a host takes no more.
    """

    most: PositiveCount = 20


class ExampleFilter:
    """Passes the hosts that run fewer processes than a given number."""

    def __init__(self, options: ExampleOptions) -> None:
        self._most = options.most

    def mask(self, hosts: HostView, process: ProcessView) -> BoolArray:
        """Return one boolean for each host; each depends on that host alone."""
        return hosts.processes < self._most

    def reason(self, hosts: HostView, process: ProcessView, row: int) -> str:
        """Return why the host of a row fails, as `rosrm explain` shows it."""
        return f"it runs {hosts.processes[row]} processes; at most {self._most} are allowed"


@hookimpl
def register_filters() -> list[FilterOffer]:
    """Offer the filter by the name with which cluster.yaml chooses it."""
    return [
        FilterOffer(
            name="example",
            create=ExampleFilter,
            options=ExampleOptions,
            summary="a largest number of processes for each host",
        )
    ]
