"""Configuration files `cluster.yaml`, `host.yaml` and `work.yaml`: loaders with all checks.

The settings themselves (`rosrm.config.settings`) import without pydantic and YAML, because the
runtimes of master and slave need only those.
"""
