"""Migration strategies of rosrm."""
