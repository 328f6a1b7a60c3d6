"""Replicas of snapshots: kept for other hosts, sent, and fetched."""
