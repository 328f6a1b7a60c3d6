"""Launch files of ROS 2 on a cluster of rosrm.

`resolve` is a process of its own that visits a launch file with the real `launch`, and starts
nothing; it prints the `model`. `translate` turns the model into an application, `cli` applies it.
"""
