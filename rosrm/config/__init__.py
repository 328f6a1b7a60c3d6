"""Configuration files `cluster.yaml`, `host.yaml` and `work.yaml`: loaders with all checks.

`rosrm.config.settings` imports neither pydantic nor YAML, because the runtimes of master and slave
import it.
"""
