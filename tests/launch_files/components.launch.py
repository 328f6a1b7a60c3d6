"""Containers, and components that are loaded into them."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, GroupAction
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import (
    ComposableNodeContainer,
    LoadComposableNodes,
    Node,
    PushRosNamespace,
)
from launch_ros.descriptions import ComposableNode
from launch_ros.substitutions import FindPackageShare

SHARE = FindPackageShare("demo_robot")


def generate_launch_description():
    return LaunchDescription(
        [
            DeclareLaunchArgument("with_viewer", default_value="false"),
            GroupAction(
                [
                    PushRosNamespace("camera"),
                    ComposableNodeContainer(
                        package="demo_robot",
                        executable="talker",
                        name="pipeline",
                        namespace="",
                        composable_node_descriptions=[
                            ComposableNode(
                                package="demo_parts",
                                plugin="demo::Camera",
                                name="source",
                                parameters=[
                                    {"rate": 30, "offset": [0.5, 1.0]},
                                    {"map": PathJoinSubstitution([SHARE, "maps/hall.yaml"])},
                                    PathJoinSubstitution([SHARE, "config/params.yaml"]),
                                ],
                                remappings=[("image", "raw")],
                                extra_arguments=[{"use_intra_process_comms": True}],
                            ),
                            ComposableNode(package="demo_parts", plugin="demo::Unnamed"),
                            ComposableNode(
                                package="demo_parts",
                                plugin="demo::Viewer",
                                name="viewer",
                                condition=IfCondition(LaunchConfiguration("with_viewer")),
                            ),
                        ],
                    ),
                ]
            ),
            LoadComposableNodes(
                target_container="/camera/pipeline",
                composable_node_descriptions=[
                    ComposableNode(
                        package="demo_parts",
                        plugin="demo::Filter",
                        name="filter",
                        namespace="camera",
                    ),
                ],
            ),
            Node(package="demo_robot", executable="talker", output="screen"),
        ]
    )
