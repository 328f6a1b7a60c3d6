"""Plugins: their contracts, their hooks, and the registry of what is installed.

hookspecs.py         every hook, in one list
contracts.py         what a probe, policy, strategy or port implements, and what it offers
options.py           the options of a process, merged over those of the cluster
units.py             numbers with units in options
discovery.py         loads the installed plugins, and calls their hooks
registry.py          selects plugins by name, and checks their options
declared_fields.py   the fields of a process that an offer declares to read
plugin_calls.py      the guard around every call of a plugin
time_limit.py        the deadline of a call
"""
