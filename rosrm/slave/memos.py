"""Memos that the supervisor stores for a later run of the slave, which knows no specs."""

from __future__ import annotations

import json
from dataclasses import astuple, replace

from rosrm.core.slave.watches import Memo
from rosrm.model.codec import from_plain, to_plain


def to_memo(memo: Memo) -> str:
    """Return a memo as text, most parts as lists of their fields; "" if it is empty."""
    if memo == Memo():
        return ""
    awaited, watch, devices, artifacts, lifecycle, _ = astuple(replace(memo, loads=None))
    loads = to_plain(memo.loads)
    plain = {"awaited": awaited, "watch": watch}
    given = {"devices": devices, "artifacts": artifacts, "lifecycle": lifecycle, "loads": loads}
    return json.dumps({**plain, **{name: value for name, value in given.items() if value}})


def from_memo(text: str) -> Memo | None:
    """Return the memo of a text; None if another version of the slave wrote it."""
    try:
        plain = json.loads(text)
        return from_plain(Memo, plain) if plain else None
    except (ValueError, RecursionError):
        return None
