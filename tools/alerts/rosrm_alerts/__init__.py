"""Alerts on events and readings of a cluster, and the sinks that pass them on.

conditions   alerts and their conditions: values
watch        PURE: which alerts begin and end
rehearsal    PURE: the tests that an alerts file has
alerts_file  alerts.yaml -> checked alerts, sinks and tests
outbox       notices that have not been delivered yet, on disk
delivery     one thread for each sink
service      `rosrm alerts run`: the cluster's listing -> watch -> outbox
sinks/       webhook, command and MCAP file
"""
