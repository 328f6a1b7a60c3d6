"""Runtime of the slave: sampling, and starting, watching and stopping processes on one host."""
