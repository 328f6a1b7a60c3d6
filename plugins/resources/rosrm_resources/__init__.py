"""Probes of rosrm: cpu, memory, disk, gpu and network."""
