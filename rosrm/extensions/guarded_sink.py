"""An event sink behind the guard; no other object of rosrm calls a sink."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from functools import partial
from operator import methodcaller
from typing import TYPE_CHECKING

from rosrm.errors import PluginError
from rosrm.extensions.guard import LOADING_LIMIT, guarded
from rosrm.extensions.plugin_calls import titled
from rosrm.extensions.sinks import EventSink, NoticesRefused

if TYPE_CHECKING:
    from typing_extensions import Self

    from rosrm.model.notices import Notice

_log = logging.getLogger("rosrm.plugins")


class GuardedSink:
    """Calls of an event sink, which is closed at the end of a `with` block.

    Args:
        name: of the sink, as its user knows it.
        sink: made by a plugin.
    """

    def __init__(self, name: str, sink: EventSink) -> None:
        self._whom, self._sink = titled("sink", name), sink

    def send(self, notices: Sequence[Notice], seconds: float = LOADING_LIMIT) -> None:
        """Pass notices on.

        Args:
            notices: the oldest first.
            seconds: time-out, as in `guarded`.

        Raises:
            NoticesRefused: the receiver will never take them.
            PluginError: any other failure.
        """
        guarded(
            partial(methodcaller("send", notices), self._sink), whom=self._whom, hook="send",
            seconds=seconds, lets=(NoticesRefused,),
        )  # fmt: skip

    def close(self) -> None:
        """Close the sink; log a failure, which must not replace an earlier one."""
        try:
            guarded(partial(methodcaller("close"), self._sink), whom=self._whom, hook="close")
        except PluginError as fault:
            _log.warning("%s: close failed: %s", self._whom, fault)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
