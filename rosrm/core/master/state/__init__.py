"""The state of the master's core: data, and the rules that keep it consistent."""
