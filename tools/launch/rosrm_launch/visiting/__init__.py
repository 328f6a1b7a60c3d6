"""Visit of a launch file with the real `launch`, which records processes instead of starting them.

Only this package imports `launch` and `launch_ros`. It reads attributes that they do not publish
(`hidden`), because neither offers a way to inspect a description.
"""

from rosrm_launch.visiting.arguments import BadArguments, declared
from rosrm_launch.visiting.walk import resolved

__all__ = ["BadArguments", "declared", "resolved"]
