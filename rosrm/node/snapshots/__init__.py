"""Snapshots of a stateful node: the newest is written to disk, and restored at the next start."""
