"""The slave's core: one event goes in, commands come out.

reducer.py       table of events and their effects
events.py, commands.py
orders.py        orders of the master as events
handlers.py      one handler for each event
state.py         the instances on this host
watches.py       readiness and health checks; health.py evaluates the checks
components.py    components of containers
lifecycle_nodes.py  transitions of lifecycle nodes
steps.py         results of an event for both
fencing.py, master_clock.py
"""
