"""Handoff of a node's state from its source instance to its destination, by topics alone."""
