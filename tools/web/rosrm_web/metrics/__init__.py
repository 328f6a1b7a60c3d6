"""Metrics of a cluster for Prometheus.

`table` has their names and labels, `sampling` takes their values from a listing, `counting` from
events, and `exposition` writes them as text. `command` is `rosrm metrics`, `endpoint` GET /metrics.
"""
