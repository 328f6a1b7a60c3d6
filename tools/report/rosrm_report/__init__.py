"""Reports of whole runs: one HTML file that opens without a network.

sources.py    a directory, journal or record as events, readings and logs
model.py      values of a report
extract.py    events and readings -> report
recorded.py   a record as events and readings
svg.py        pictures
page.py       report -> HTML
writing.py    source -> report -> file
cli.py        command `rosrm report`
"""
