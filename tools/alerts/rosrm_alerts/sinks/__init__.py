"""Event sinks that are shipped with rosrm."""
