"""The supervisor's core: one state machine for each instance."""
