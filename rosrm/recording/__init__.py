"""The record of a master's run: everything that its core was told, so that it can be told again.

`frames` knows the file, `encoding` the events in it, and `reading` puts a run together again. All
of it is pure; `rosrm.master.recorder` writes the file.
"""
