"""A component as a process of its own: its node runs in a container of its host.

The process stands for the node: it imports no ROS, and exists as long as the node. So rosrm places,
watches, restarts and moves a component like any process, and a container knows nothing of plans.
The how-to about components has the use, decision 0068 the reasons.
"""
