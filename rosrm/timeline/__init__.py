"""Timeline of a cluster from its events, for reports and for the page in the browser. Pure.

values.py     placements, moves, waits, starts, failures, times of hosts
reading.py    events, one after the other -> all of these
clock.py      seconds of events, over restarts of the master
processes.py  histories of processes
hosts.py      times in which hosts were gone or over a limit
lanes.py      placements -> rows of a picture
"""
