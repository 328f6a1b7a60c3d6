"""Processes in containers: the launcher `podman`."""
