"""CRIU engine: process dump and restore. Optional: without CRIU everything else in rosrm works."""
