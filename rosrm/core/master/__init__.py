"""The master's core: one event goes in, commands come out.

reducer.py     the transition table: the handler of each event
events.py, commands.py, outcomes.py, settings.py
master_state.py, state/   data and the rules that keep it consistent; invariants.py checks them
tick.py        periodic work
requests.py    requests of clients; rights.py, quotas.py, stores.py, contradictions.py,
               process_defaults.py, pruning.py, graph_names.py, cancellation.py
answers.py     answers of slaves to orders; executor_results.py, reloading.py, restarts.py
garbage.py     removal of what has ended from memory and journal
lifecycle.py   an instance from start to end; rescheduling.py, time_limits.py, schedules.py
adoption.py    a process that runs before it is submitted
start_order.py starts after other processes, stops before them; dependants.py
consequences.py the end of each step: what a change makes possible or necessary
listing.py     rows of the listings, `rosrm explain`; plugin_failures.py
diagnostics.py statuses of hosts and processes for `/diagnostics`
applications/  versions of applications, replacement of processes, plans
modes/         sets of applications: the one in force, its limits and weights
scheduling/    choice of a host for a process: filter, score, pick
assignment/    assignment of waiting processes, reservation of their load
hosts/         registration, readings, loss, fencing, re-adoption
migration/     plans, their steps, eviction, preemption, rebalancing, standbys, failover
checkpoint/    replicas of snapshots, checkpoint images
recovery/      restart of the master
"""
