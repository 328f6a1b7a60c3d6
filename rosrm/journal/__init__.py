"""The durable record of intent: what shall run, the queue, assignments and migrations.

sqlite.py     the journal
errors.py     which failures of a disk pass, and which do not
recovery.py   a journal that lost its newest records or cannot be read
"""
