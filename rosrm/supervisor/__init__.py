"""The supervisor of one host: parent of its processes, without ROS; it outlives the slave.

    __main__.py           starts it: subreaper, daemon, then the bare interpreter
    bare_interpreter.py   where that interpreter begins
    server.py             its event loop, the imperative shell around `rosrm.core.supervisor`
    spawn.py              spawns, signals and reaps
    process_tree.py       the process tree of an instance
    procfs.py             reads in /proc which processes belong to an instance
    instance_record.py    what survives its own death: instances.jsonl
    lease_file.py         the last contact with the master, for after a restart
    logs.py, log_index.py the processes' log files: rotated, bounded, indexed by time
    messages.py           what travels between it and the slave, as json_lines.py
    discovery.py          finds the supervisor of a host, or starts one
    takeover.py           a new supervisor takes over the processes of one that was killed
    client.py             the slave's side, with client_values.py

All but the slave's side is imported by the supervisor itself, which must stay small: standard
library only, and of that only what is light.
"""
