"""Launch of assignments: command line, environment and start."""
