"""Containers, and components that are loaded into them."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, GroupAction
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import (
    ComposableNodeContainer,
    LoadComposableNodes,
    Node,
    PushRosNamespace,
)
from launch_ros.descriptions import ComposableNode


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
                                package="demo_parts", plugin="demo::Camera", name="source"
                            ),
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
