"""The event sinks of rosrm."""

from __future__ import annotations

from collections.abc import Sequence

from rosrm import EventSink, SinkOffer, hookimpl
from rosrm_alerts.sinks.webhook_options import WebhookOptions


@hookimpl
def register_event_sinks() -> Sequence[SinkOffer]:
    """Offer webhook, command and MCAP file."""
    # Imported only here, because a slave imports this module, too, and needs no sinks.
    from rosrm_alerts.sinks.command import Command, CommandOptions  # noqa: PLC0415
    from rosrm_alerts.sinks.mcap_file import McapFile, McapOptions  # noqa: PLC0415

    return [
        SinkOffer(
            "webhook", _webhook, WebhookOptions, "posts notices to a web address, as JSON",
            batch=100,
        ),
        SinkOffer("command", Command, CommandOptions, "starts a command for each notice"),
        SinkOffer(
            "mcap", McapFile, McapOptions, "writes notices to a file for Foxglove or Lichtblick",
            batch=1000,
        ),
    ]  # fmt: skip


def _webhook(options: WebhookOptions) -> EventSink:
    from rosrm_alerts.sinks.webhook import Webhook  # noqa: PLC0415 - the HTTP client

    return Webhook(options)
