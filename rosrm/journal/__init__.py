"""Journal of intent: desired processes, the queue, assignments and migrations, durably stored.

sqlite.py      the journal
retention.py   bounds on the event record
errors.py      errors, temporary and permanent, with remedies
recovery.py    recovery of a damaged journal
"""
