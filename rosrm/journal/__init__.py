"""Journal of intent: desired processes, the queue, assignments and migrations, durably stored.

sqlite.py      the journal
retention.py   bounds on the event record
errors.py      failures of a disk: those that may pass, and permanent ones
recovery.py    repair of a journal with a gap, or of an unreadable one
"""
