"""Values that all parts share, and their conversion to JSON.

values.py               processes, hosts, instances, resources
applications.py         applications: targets, planned actions, rows
modes.py                modes: sets of applications of which one is in force
notices.py              notices of events and alerts, as event sinks get them
artifacts.py            files and directories that processes get on their hosts
placeholders.py         placeholders in the texts of a process, which its host replaces
start_trace.py          trace of one start in the environment of its process, traced_values.py
parameters.py           ROS parameters from several sources, by patterns of nodes
relative_files.py       words of a command that name files in its working directory
devices.py              devices of hosts, needs of processes, and what a process gets
plan.py                 plans of migrations: steps, undo, commit
orders.py               orders of the master to a slave
event_kinds.py          the kinds of events in the event record
records.py              records and intents, and the protocol of a journal
rows.py                 rows of listings
diagnostics.py          diagnostic statuses and their levels
requester.py            sender of a request, and its rights on processes
ros_settings.py         ROS settings of a part: domain, discovery, transports, interface
codec.py                conversion of values to JSON and back
lazy.py                 mappings that are rendered and encoded at the first read
spec_text.py            JSON of a spec
remembered.py           cache of function results by the identity of the argument
durations.py            bounds of all times
sizes.py                size of values, for bounds of what is stored
ledger.py               what each principal has in a store, and its bounds
links.py                measurements of links between hosts
arrays.py               the array of a job, and the placeholder of its index
schedules.py            times at which a job starts again
job_checks.py           rules for arrays and schedules
stop_rules.py           rule for the stop of a process
limits.py               rules for limits and scheduling of a process
adoption.py             a running process that becomes the first instance, adoption_rules.py
container_rules.py      rules for the container of a process
component_rules.py      rules for the components that a slave loads into a container
lifecycle_rules.py      rules for processes whose slave changes their lifecycle state
secret_rules.py         rules for the secrets of a process
dependencies.py         rules on processes that start after each other
gang_rules.py           rules on gangs that can never start
contradictions.py       contradictions between rules on neighbours
description_checks.py   checks of the description of a host, and of names
"""
