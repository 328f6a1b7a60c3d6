"""The same core on virtual time: what would have been, with other policies, weights and hosts.

The simulation is pure. `workload` says what is simulated, `engine` runs the cores of the master
and of the slaves on it, `machine` is the model of one host, `meter` measures a run, real or
simulated, and `agreement` compares two. `replay` tells a master's core again what a record holds,
and `extraction` makes a workload of a record.

The command `rosrm simulate` is not pure: `cli` and `runs` carry it out, `workload_file` and
`variants` read its files, `tables` and `picture` show the result.
"""
