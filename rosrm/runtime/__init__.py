"""Code shared by the entry points of master, slave and supervisor.

bootstrap.py       settings and plugins, passed from the command to the runtime
local_zone.py      time zone of the machine
state_lock.py      one runtime for one state directory
private_files.py   owner, mode and links of directories and files
durable.py         how state is written, and what survives a kill or the loss of power
cgroups.py         control groups: mounts, the own group, delegation
disk_space.py      free space on the disk of a directory
addresses.py       IPv4 addresses of the network interfaces
settings_check.py  check of a settings file, in a process of its own
parent_death.py    end of a process with its parent
process_title.py   names of the parts in `ps -e`
process_end.py     end of a process in which a plugin has left threads
oom_score.py       protection of an agent from the OOM killer
timer_slack.py     exact ends of the waits of a process
dispositions.py    handlers of signals that the starter does not ignore
signalling.py      signals to other processes, which may have ended
log_tail.py        last lines of a log, for error texts
memory_file.py     files without a place on a disk
crash_notes.py     notes of the running calls of plugins, for the next start
path_calls.py      threads for calls on paths that users name
file_thread.py     a thread for calls on a directory that may not answer
worker.py          a thread for blocking work of a loop
ros_wheels.py      the environment of ROS 2 from wheels
"""
