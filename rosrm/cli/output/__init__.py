"""What commands print: tables, pictures, JSON, log lines."""
