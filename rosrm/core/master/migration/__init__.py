"""Migrations: why one starts, its plan, the execution of its steps, standbys, failover."""
