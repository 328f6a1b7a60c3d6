"""Handoff of a node's state from its source instance to its destination, over ROS topics only."""
