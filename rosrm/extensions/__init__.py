"""Plugins: contracts, hooks, and the registry of installed plugins.

hookspecs.py         every hook, in one list
contracts.py         Protocols of probes, policies, strategies and launchers, and their offers
options.py           the options of a process, merged over those of the cluster
units.py             numbers with units in options
installed.py         the installed plugins, as entry points
discovery.py         loads the installed plugins, and calls their hooks
registry.py          selects plugins by name, and makes their objects
made.py              the made objects, and checks of them
declared_fields.py   the fields of a process that an offer declares to read
plugin_calls.py      the guard around every call of a plugin
time_limit.py        the deadline of a call
"""
