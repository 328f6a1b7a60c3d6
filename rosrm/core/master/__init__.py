"""The master's core: one event in, commands out.

reducer.py     one row for each event
events.py, commands.py, settings.py
tick.py        periodic work
requests.py    what users request; pruning.py, graph_names.py
lifecycle.py   from start to end of an instance
listing.py     the rows that users read
state/         data only
scheduling/    on which host a process is placed
hosts/         registration, readings, loss, fencing, re-adoption
migration/     plans, their steps, eviction, standbys, failover
checkpoint/    replicas of snapshots, checkpoint images
recovery/      restart of the master
"""
