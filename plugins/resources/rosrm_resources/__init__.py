"""The probes that rosrm ships: cpu, memory, disk, gpu and network."""
