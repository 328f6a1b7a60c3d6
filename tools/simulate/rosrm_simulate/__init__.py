"""Simulation: the same cores on virtual time, with other policies, weights and hosts.

The simulation is pure. `workload` describes its input, `engine` runs the cores of the master and of
the slaves, `machine` is the model of one host, `meter` measures a run, real or simulated, and
`agreement` compares two. `replay` feeds a record to a master's core, and `extraction` turns a
record into a workload.

The command `rosrm simulate` is not pure: `cli` and `runs` carry it out, `workload_file` and
`variants` read its files, `tables` and `picture` show the result.
"""
