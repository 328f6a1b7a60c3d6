"""Assignments: a waiting process gets a host, and its load is reserved there."""
