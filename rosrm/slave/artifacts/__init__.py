"""Artifacts of processes on a host: fetched from the master before a start, and cached.

fetch.py     transfer of one artifact to this host
service.py   preparation of the artifacts of an instance
"""
