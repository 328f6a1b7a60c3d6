"""Assignment of waiting processes to hosts, and reservation of their load."""
