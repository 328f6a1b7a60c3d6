"""Arguments, conditions, groups, namespaces, remappings, parameter files and a function."""

from launch import LaunchDescription
from launch.actions import (
    DeclareLaunchArgument,
    GroupAction,
    IncludeLaunchDescription,
    OpaqueFunction,
    SetEnvironmentVariable,
)
from launch.conditions import IfCondition, UnlessCondition
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node, PushRosNamespace, SetParameter, SetRemap
from launch_ros.substitutions import FindPackageShare


def talkers(context):
    number = int(LaunchConfiguration("talkers").perform(context))
    return [
        Node(package="demo_robot", executable="talker", name=f"talker_{index}")
        for index in range(number)
    ]


def generate_launch_description():
    share = FindPackageShare("demo_robot")
    params = PathJoinSubstitution([share, "config", "params.yaml"])
    map_file = PathJoinSubstitution([share, "maps", "hall.yaml"])
    print("talkers.launch.py prints")
    return LaunchDescription(
        [
            DeclareLaunchArgument("talkers", default_value="2", description="Number of talkers"),
            DeclareLaunchArgument("mode", choices=["slow", "fast"], default_value="slow"),
            DeclareLaunchArgument("simulated", default_value="false"),
            OpaqueFunction(function=talkers),
            GroupAction(
                [
                    PushRosNamespace("left"),
                    SetParameter("use_sim_time", LaunchConfiguration("simulated")),
                    SetRemap("chatter", "/chatter"),
                    SetEnvironmentVariable("SIDE", "left"),
                    Node(
                        package="demo_robot",
                        executable="talker",
                        name="driver",
                        parameters=[params, {"map": map_file, "gains": [1.0, 2.0]}],
                        remappings=[("image", "image_raw")],
                        arguments=["--config", map_file],
                    ),
                    Node(
                        package="demo_robot",
                        executable="talker",
                        condition=IfCondition(LaunchConfiguration("simulated")),
                    ),
                ]
            ),
            GroupAction(
                [
                    PushRosNamespace("right"),
                    Node(
                        package="demo_robot",
                        executable="talker",
                        name="driver",
                        parameters=[{"text": "first"}, params],
                        prefix="nice -n 5",
                        additional_env={"LEVEL": "7"},
                    ),
                    Node(
                        package="demo_robot",
                        executable="talker",
                        name="real",
                        condition=UnlessCondition(LaunchConfiguration("simulated")),
                    ),
                ]
            ),
            IncludeLaunchDescription(
                PathJoinSubstitution([share, "launch", "sensors.launch.xml"]),
                launch_arguments=[("rate", "5.0")],
            ),
        ]
    )
