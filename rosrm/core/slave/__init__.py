"""The slave's core: one event in, commands out.

reducer.py       one row for each event
events.py, commands.py
orders.py        orders of the master as events
handlers.py      one handler for each event
state.py         the instances that the slave holds
watches.py       the values of readiness and health; health.py judges health
fencing.py, master_clock.py
"""
