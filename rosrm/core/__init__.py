"""Pure logic of master, slave and supervisor: no ROS, clock, thread, file or log; time is given."""
