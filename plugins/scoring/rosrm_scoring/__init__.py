"""Scoring policies of rosrm: weighted (Eq. 1 of the paper) and threshold."""
