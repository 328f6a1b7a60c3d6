"""The cluster of `rosrm up`: a master and several hosts on this machine, in one terminal.

slices.py    the hosts, each with a share of this machine
cluster.py   start and end of master and slaves
cleaner.py   the program that ends and removes what a killed `rosrm up` has left
session.py   the command while the cluster runs: submission, events, faults
"""
