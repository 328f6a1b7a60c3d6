"""States that a loss of power may leave on the disk, and what the next boot makes of each."""
