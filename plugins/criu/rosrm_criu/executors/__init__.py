"""Executors of the plan steps of `criu`, run by slaves."""
