"""What the master does after a restart, and while its journal cannot be written."""
