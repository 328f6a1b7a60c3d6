"""Snapshots: the files of one process, as its node and its slave write and read them.

A directory belongs to one process. Its node writes `state.0` and `state.1` in turn, so that one of
them is complete even after a kill. Its slave writes `copy`, a replica from another host. The newest
complete file counts. docs/reference/handoff-protocol.md has the format.
"""

from rosrm.snapshots.format import (
    LARGEST,
    Block,
    Damaged,
    Head,
    Listing,
    TransferPart,
    decoded,
    decoded_head,
    encoded_head,
)
from rosrm.snapshots.reader import (
    COPY,
    SLOTS,
    files,
    newest,
    newest_content,
    newest_head,
    peek,
    read,
)
from rosrm.snapshots.writer import CopyWriter, SlotWriter, drop, write_copy

__all__ = [
    "COPY",
    "LARGEST",
    "SLOTS",
    "Block",
    "CopyWriter",
    "Damaged",
    "Head",
    "Listing",
    "SlotWriter",
    "TransferPart",
    "decoded",
    "decoded_head",
    "drop",
    "encoded_head",
    "files",
    "newest",
    "newest_content",
    "newest_head",
    "peek",
    "read",
    "write_copy",
]
