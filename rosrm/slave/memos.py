"""Memos that the supervisor stores for a later run of the slave: readiness and health checks."""

from __future__ import annotations

import json
from dataclasses import astuple
from typing import Any

from rosrm.core.slave.watches import Awaited, Memo, Watch
from rosrm.model.values import Health


def to_memo(memo: Memo) -> str:
    """Return a memo as text; "" if it is empty."""
    if memo.awaited is None and memo.watch is None:
        return ""
    awaited = None if memo.awaited is None else astuple(memo.awaited)
    watch = None if memo.watch is None else astuple(memo.watch)
    return json.dumps({"awaited": awaited, "watch": watch})


def from_memo(text: str) -> Memo | None:
    """Return the memo of a text; None if another version of the slave wrote it."""
    try:
        fields = json.loads(text)
        awaited, watch = fields["awaited"], fields["watch"]
        return Memo(
            None if awaited is None else _awaited(awaited), None if watch is None else _watch(watch)
        )
    except (KeyError, TypeError, ValueError):
        return None


def _awaited(value: Any) -> Awaited:
    node_name, timeout, seen = value
    return Awaited(str(node_name), float(timeout), int(seen))


def _watch(value: Any) -> Watch:
    (topic, rate, lifecycle, timeout), topics, services, restarts, paused = value
    wanted = Health(str(topic), float(rate), str(lifecycle), float(timeout))
    return Watch(
        wanted, tuple(map(str, topics)), tuple(map(str, services)), bool(restarts), bool(paused)
    )
