"""CRIU for rosrm: a process moves with its whole memory, and is restored from images of it."""
