"""The scoring policies that rosrm ships: weighted (Eq. 1 of the paper) and threshold."""
