"""The values that all parts share, and their JSON.

values.py               processes, hosts, instances, resources
plan.py                 plans of migrations: steps, undo, commit
rows.py                 the rows of listings
ros_settings.py         how a part joins the ROS graph
codec.py                the same as JSON
description_checks.py   checks of what a slave reports about its host
"""
