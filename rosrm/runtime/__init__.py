"""Code shared by the entry points of master and slave.

bootstrap.py    settings and plugins, passed from the command to the runtime
state_lock.py   one runtime for one state directory
disk_space.py   free space on the disk of a directory
ros_wheels.py   the environment of ROS 2 from wheels
"""
