"""The supervisor of one host: parent of its processes, without ROS; it outlives the slave.

    __main__.py   starts it: subreaper, daemon, then the bare interpreter
    bare.py       where that interpreter begins
    server.py     its event loop: the imperative shell around `rosrm.core.supervisor.reducer`
    children.py   spawns, signals and reaps
    members.py    reads in /proc who belongs to an instance
    record.py     what survives its own death: instances.jsonl
    logs.py       the processes' log files: rotated, bounded
    protocol.py   what travels between it and the slave
    client.py     the slave's side

All but `client.py` is imported by the supervisor itself, which must stay small: standard library
only, and of that only what is light.
"""
