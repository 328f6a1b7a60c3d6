"""Placement of processes on hosts.

filters.py      the placement rules: which hosts may take a process, and why not the others
ranking.py      filter, score, pick
decision.py     the outcome with its reasons, as `rosrm explain` shows it
feasibility.py  whether any host may ever take a process
candidates.py, host_views.py   hosts as filters and as scoring policies see them
"""
