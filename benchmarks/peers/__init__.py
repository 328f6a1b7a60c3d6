"""Comparison with Ray, Dask and a bare loop: `python -m benchmarks.peers`."""
