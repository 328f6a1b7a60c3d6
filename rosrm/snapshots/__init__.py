"""Snapshots: the files of one process, as its node and its slave write and read them.

A directory belongs to one process. Its node writes `state.0` and `state.1` in turn, so that one of
them is complete even after a kill. Its slave writes `copy`, a replica from another host. The newest
complete file counts. A replica may be encrypted; the slave decrypts it before the node starts.
docs/reference/handoff-protocol.md has the format.
"""
