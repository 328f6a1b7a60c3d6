"""The master's runtime: it carries out what the core decides."""
