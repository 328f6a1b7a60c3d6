"""Supervisor of one host: parent of its processes, without ROS; it outlives the slave.

    __main__.py           start: subreaper, daemon, then the bare interpreter
    bare_interpreter.py   entry point of the bare interpreter
    server.py             event loop, the imperative shell around `rosrm.core.supervisor`
    boot_timer.py         timer of the boot clock, for the waits of the event loop
    endpoint.py           both ends of the socket, and one supervisor for one host
    connection.py         the supervisor's side of a connection, with send_buffer.py
    spawn.py              start of one process: fork, and what its child does until the exec
    spawn_error.py        failures of a spawn
    spawn_into.py         the fork into a control group of version 2
    exec_failures.py      reasons for programs that cannot be executed
    adoption.py           checks before a process that was started without rosrm is taken over
    secret_files.py       secrets, read just before a spawn
    instance_files.py     parameters and key of an instance, written just before a spawn
    confinement.py        start of an instance within its limits
    group_trees.py        where control groups may be made
    instance_groups.py    the control groups of the instances
    descriptors.py        limit of open descriptors
    process_tree.py       process trees of the instances: signals, reaping
    procfs.py             lookup in /proc of the processes of an instance
    instance_record.py    the record that survives the supervisor's own death: instances.jsonl
    paths.py              the files in the supervisor's directory
    lease_file.py         the last contact with the master, for a restart
    logs.py, log_index.py the processes' log files: rotated, bounded, indexed by time
    log_calls.py          the loop's side of these files
    own_log.py            the supervisor's own problems: supervisor.log
    messages.py           protocol between supervisor and slave, as json_lines.py
    discovery.py          lookup of the supervisor of a host, or its start
    takeover.py           take-over of the processes of a killed supervisor
    client.py             the slave's side, with client_values.py

The supervisor imports all but the slave's side, and must stay small. So these modules import only
the standard library, and of that only light modules.
"""
