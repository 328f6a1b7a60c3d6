"""The supervisor's core: one state machine for each instance.

reducer.py       the table of phases and events; all instances of one host
transitions.py   the function of each row
events.py, commands.py, rules.py
instance.py      one instance
"""
