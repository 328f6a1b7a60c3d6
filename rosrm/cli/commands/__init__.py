"""Commands of `rosrm`, one module for each section of the help."""
