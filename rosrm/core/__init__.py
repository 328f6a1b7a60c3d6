"""Pure logic of master, slave and supervisor: no ROS, clock, thread, file or log.

The caller passes the time.
"""
