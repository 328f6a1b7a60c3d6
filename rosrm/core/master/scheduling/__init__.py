"""On which host a process is placed: demand, filters, ranking, decision, assignment."""
