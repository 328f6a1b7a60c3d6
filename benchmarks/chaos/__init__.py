"""Random faults on a lab of five hosts, and an oracle that looks at reality alone.

`faults` draws (seeded), `cluster` runs master and slaves as a service manager would, `harm` does
and undoes the faults, `trial` is the loop. `oracle`, with `reality`, `outputs` and `rules`, judges:
these four import nothing from rosrm.
"""
