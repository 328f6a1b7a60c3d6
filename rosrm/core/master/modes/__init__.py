"""Modes: requests and conditions that switch between them, and the settings of the one in force."""
