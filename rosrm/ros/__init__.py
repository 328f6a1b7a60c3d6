"""The only place that imports rclpy, with `rosrm.node`: transport, graph, message <-> value."""
