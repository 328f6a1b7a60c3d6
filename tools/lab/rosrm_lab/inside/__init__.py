"""Programs that run within a virtual host, by their paths, with the standard library alone."""
