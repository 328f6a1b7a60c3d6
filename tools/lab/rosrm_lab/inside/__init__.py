"""Programs that run within a virtual host, by their path, with the standard library alone."""
