"""Hosts: registration, readings, liveness, loss, re-adoption, fencing."""
