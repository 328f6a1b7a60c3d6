"""The slave's runtime: it samples, starts, watches and stops on one host."""
