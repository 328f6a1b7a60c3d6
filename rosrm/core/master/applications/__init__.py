"""Applications: requests, differences to the desired state, replacement, plans."""
