"""Comparison with Ray, Dask, Slurm and a bare loop: `python -m benchmarks.peers`."""
