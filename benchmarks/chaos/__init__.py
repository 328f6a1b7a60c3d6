"""Random faults on a lab of five hosts, and an oracle that judges by observation alone.

`faults` draws the faults (seeded). `cluster` runs master and slaves as a service manager would.
`fault_injector` does the faults and undoes them. `rollout` applies versions of an
application. `trial` is the loop. `oracle` judges, with `reality`, `outputs`, `rules` and
`allowances`: these five import nothing from rosrm.
"""
