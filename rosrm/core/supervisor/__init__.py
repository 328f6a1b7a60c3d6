"""The supervisor's core: one state machine for each instance.

reducer.py       the table of phases and events, and its public names
transitions.py   the function of each row
events.py, commands.py, rules.py
instance.py      one instance; instances.py: all of them
"""
