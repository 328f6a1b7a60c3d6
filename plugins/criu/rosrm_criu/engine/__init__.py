"""CRIU: a process as files, and a process again. Optional: without it everything else works."""
