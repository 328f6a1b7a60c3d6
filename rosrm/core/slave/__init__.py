"""The slave's core: one event in, commands out.

reducer.py       one row for each event
events.py, commands.py
handlers.py      what follows each event
state.py         the instances that the slave holds
watches.py       the values of readiness and health; health.py judges them
fencing.py, master_clock.py
"""
