"""Migrations: eviction, start, execution of the plan, handoff, standbys, failover."""
