"""Adoption of a running process, whose command line becomes an entry of a work file."""
