"""Plugins: contracts, hooks, and the registry of installed plugins.

hookspecs.py         every hook, in one list
contracts.py         protocols of probes, policies, filters, strategies, launchers; their offers
sinks.py             contract of event sinks
guarded_sink.py      calls of an event sink
options.py           options of a process, merged over those of the cluster
units.py             numbers with units in options
installed.py         addresses of the installed plugins (entry points)
discovery.py         import of the installed plugins, call of their hooks
registry.py          selection of plugins by name, creation of their objects
made.py              created objects, and checks of them
declared_fields.py   fields of a spec that an offer declares to read
placement.py         selected policies and filters, for the core
array_types.py       types of the arrays in the views of hosts
link_views.py        links and flows as scoring policies read them
guard.py             the guard of every call of a plugin
plugin_calls.py      record of the calls of a part
plugin_deadline.py   time-out and pauses of the plugins of a master
process_state.py     restoration of what a plugin changed in its process
answers.py           check of a whole answer against its declared type
time_limit.py        time-out of a call
"""
