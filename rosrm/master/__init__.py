"""Runtime of the master, which executes the decisions of the core."""
