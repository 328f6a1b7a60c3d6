"""The slave's publishers, services and view of the ROS graph."""
