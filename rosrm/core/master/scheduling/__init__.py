"""Placement of processes on hosts.

filters.py      placement rules: masks over hosts, with the reasons against hosts
plugin_filters.py   placement rules of plugins
ranking.py      filter, score, pick
shortlist.py    the hosts with the lowest scores
decision.py     outcome with its reasons, for `rosrm explain`
proximity.py    hosts near other processes or apart from them
traffic.py      load that the flows of a process would put on links
feasibility.py  hosts that may ever take a process
candidates.py, host_views.py   views of hosts for filters and for plugins
"""
