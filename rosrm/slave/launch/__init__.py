"""From an assignment to a command line with its environment."""
