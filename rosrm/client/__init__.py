"""Python client of the master; `rosrm.Client` is its public name.

client.py       the client: requests, listings, events, logs, waiting
connecting.py   finds the master, with the settings that commands use
waiting.py      waits for states of processes and hosts
logs.py         reads the logs of processes from the slaves that hold them
artifacts.py    sends the contents of artifacts before a submission
retrying.py     repeats requests while the master does not answer
"""
