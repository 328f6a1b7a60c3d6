"""Checkpoint policies of rosrm."""
