"""Python client of the master; `rosrm.Client` is its public name.

client.py       the client: requests, listings, events, logs, waiting
connecting.py   finds the master, with the settings that commands use
event_feed.py   follows the event record, also across a journal gap
waiting.py      waits for states of processes and hosts
logs.py         reads the logs of processes from the slaves that hold them, or from an archive
log_collection.py  requests new output of all processes for an archive
no_master.py    stands for the connection where only collected logs are read
start_traces.py  submissions with a trace, and the table of their hand-overs
artifacts.py    sends the contents of artifacts before a submission
retrying.py     repeats requests while the master does not answer
"""
