"""What the supervisor remembers for a later run of the slave: how an instance becomes ready."""

from __future__ import annotations

import json

from rosrm.core.slave import Awaited


def to_memo(awaited: Awaited) -> str:
    """As a text."""
    return json.dumps([awaited.node_name, awaited.timeout, awaited.seen])


def from_memo(memo: str) -> Awaited | None:
    """The inverse of `to_memo`; None for what another version of the slave may have written."""
    try:
        node_name, timeout, seen = json.loads(memo)
        return Awaited(str(node_name), float(timeout), int(seen))
    except (TypeError, ValueError):
        return None
