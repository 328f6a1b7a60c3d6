"""The values that all parts share, and their JSON.

values.py               processes, hosts, instances, resources
plan.py                 plans of migrations: steps, undo, commit
orders.py               orders of the master to a slave
event_kinds.py          the kinds of events in the event record
rows.py                 the rows of listings
ros_settings.py         how a part joins the ROS graph
codec.py                values as JSON
durations.py            bound of all times
description_checks.py   checks of what a slave reports about its host
"""
