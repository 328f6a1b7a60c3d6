"""Output of the commands: tables, live views, JSON, log lines."""
