"""What slaves do in the plans of `criu`: each function is an executor."""
