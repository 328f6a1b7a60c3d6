"""The master's core: one event in, commands out.

reducer.py     one row for each event
events.py, commands.py, outcomes.py, settings.py
master_state.py, state/   data only
tick.py        periodic work
requests.py    what users request; pruning.py, graph_names.py
answers.py     what slaves answer to orders
lifecycle.py   from start to end of an instance
listing.py     the rows that users read; plugin_failures.py
scheduling/    on which host a process is placed
assignment/    a waiting process gets a host, and its load is reserved there
hosts/         registration, readings, loss, fencing, re-adoption
migration/     plans, their steps, eviction, standbys, failover
checkpoint/    replicas of snapshots, checkpoint images
recovery/      restart of the master
"""
