"""The slave's core: one event in, commands out."""
