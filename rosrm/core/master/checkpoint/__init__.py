"""Replicas of snapshots and checkpoint images: which are made, and where they are kept."""
