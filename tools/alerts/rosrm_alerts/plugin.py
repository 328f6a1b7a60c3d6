"""The event sinks of rosrm."""

from __future__ import annotations

from collections.abc import Sequence

from rosrm import EventSink, SinkOffer, hookimpl
from rosrm_alerts.sinks.command import Command, CommandOptions
from rosrm_alerts.sinks.mcap_file import McapFile, McapOptions
from rosrm_alerts.sinks.webhook_options import WebhookOptions


@hookimpl
def register_event_sinks() -> Sequence[SinkOffer]:
    """Offer webhook, command and MCAP file."""
    return [
        SinkOffer(
            "webhook", _webhook, WebhookOptions, "posts notices to a web address, as JSON",
            batch=100,
        ),
        SinkOffer("command", _command, CommandOptions, "starts a command for each notice"),
        SinkOffer(
            "mcap", _mcap, McapOptions, "writes notices to a file for Foxglove or Lichtblick",
            batch=1000,
        ),
    ]  # fmt: skip


def _webhook(options: WebhookOptions) -> EventSink:
    from rosrm_alerts.sinks.webhook import Webhook  # noqa: PLC0415 - the HTTP client

    return Webhook(options)


def _command(options: CommandOptions) -> EventSink:
    return Command(options)


def _mcap(options: McapOptions) -> EventSink:
    return McapFile(options)
