"""Replicas of snapshots and checkpoint images: creation, placement, removal."""
