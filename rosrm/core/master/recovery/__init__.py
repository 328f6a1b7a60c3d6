"""Recovery: restart of the master, journal gap, journal stall."""
