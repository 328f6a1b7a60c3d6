"""Recording of a master's run: every input of its core, for a replay.

frames.py     file format
encoding.py   conversion of events and decisions
reader.py     reader of a whole recording

`rosrm.master.recorder` writes the file.
"""
