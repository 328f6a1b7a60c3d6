"""Connection without a master, for collected logs: lists nothing, and refuses everything else."""

from __future__ import annotations

from rosrm.errors import NoMaster
from rosrm.model.rows import Listing, LogPart


class NoConnection:
    """Stands for the connection to a master that did not answer."""

    def list(self, **_parts: object) -> Listing:
        """Return an empty listing."""
        return Listing("", 0.0, 0)

    def read_log(self, host: str, *_query: object, **_more: object) -> LogPart:
        """Raise `NoMaster`."""
        raise NoMaster(f"no master answers, so the slave of {host} cannot be asked")

    def close(self) -> None:
        """Do nothing."""
