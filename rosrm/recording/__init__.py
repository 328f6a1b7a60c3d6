"""Recording of a master's run: every input of its core, so that the run can be replayed.

`frames` handles the file, `encoding` the events in it, and `reader` assembles the run. All of it is
pure; `rosrm.master.recorder` writes the file.
"""
