"""Measurements of rosrm; each module is run by `python -m benchmarks.NAME`.

Each shows its progress on standard error and prints one JSON object as its last line, with the
machine, the versions and the number of runs (`machine.py`). They are not tests: no figure fails.
"""
