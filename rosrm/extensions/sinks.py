"""Contract of event sinks, which pass events and alerts on to other systems."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

from rosrm.errors import RosrmError
from rosrm.extensions.contracts import NoOptions

if TYPE_CHECKING:  # a slave imports this module, but has no notices
    from rosrm.model.notices import Notice


class NoticesRefused(RosrmError):
    """The receiver refuses these notices for good; a repetition would be refused, too."""


class EventSink(Protocol):
    """Passes notices on to another system.

    `send` may block, because each sink has its own thread. rosrm keeps notices on disk until `send`
    has returned, and sends them again after an exception. Therefore a receiver may get a notice
    twice, with the same `id`.
    """

    def send(self, notices: Sequence[Notice]) -> None:
        """Pass notices on, the oldest first; at least one.

        Raises:
            NoticesRefused: the receiver will never take them; they are dropped.
            Exception: any other failure; the same notices are sent again later.
        """

    def close(self) -> None:
        """Release files and connections; called once, at the end."""


@dataclass(frozen=True)
class SinkOffer:
    """Registers an event sink; the fields are as in `ProbeOffer`.

    Attributes:
        batch: most notices in one call of `send`.
    """

    name: str
    create: Callable[[Any], EventSink]
    options: type[Any] = NoOptions
    summary: str = ""
    batch: int = 1
