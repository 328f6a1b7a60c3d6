"""The supervisor's core: one state machine for each instance.

reducer.py       the table of phases and events; all instances of one host
transitions.py   one function for each row of the table
events.py, commands.py, rules.py
instance.py      one instance
"""
