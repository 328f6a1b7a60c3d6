"""CRIU plugin of rosrm: moves processes with their whole memory, and restores them from images."""
