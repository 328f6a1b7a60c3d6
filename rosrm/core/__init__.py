"""The pure part: it decides. No ROS, clock, thread, file or log; time is an argument."""
