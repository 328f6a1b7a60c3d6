"""Example applications for rosrm: LiDAR SLAM on ROS 2, and processes that hold memory.

Nothing is imported here: `map_piece` must set OMP_NUM_THREADS before numpy is first imported, and
`holder` must stay without numpy.
"""
