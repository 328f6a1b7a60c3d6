"""Environment, groups, and options of processes and nodes."""

import os

from launch import LaunchDescription
from launch.actions import (
    AppendEnvironmentVariable,
    ExecuteProcess,
    GroupAction,
    LogInfo,
    OpaqueFunction,
    RegisterEventHandler,
    SetEnvironmentVariable,
    SetLaunchConfiguration,
    UnsetEnvironmentVariable,
)
from launch.event_handlers import OnExecutionComplete, OnProcessExit, OnProcessStart
from launch.substitutions import LocalSubstitution, PathJoinSubstitution
from launch_ros.actions import (
    Node,
    PushRosNamespace,
    SetParameter,
    SetParametersFromFile,
    SetRemap,
    SetROSLogDir,
)
from launch_ros.substitutions import FindPackageShare


def node(name, **options):
    return Node(package="demo_robot", executable="talker", name=name, **options)


def generate_launch_description():
    params = PathJoinSubstitution([FindPackageShare("demo_robot"), "config", "params.yaml"])
    first = ExecuteProcess(cmd=["sh", "-c", "true"], name="first")

    def register(context):
        context.register_event_handler(
            OnProcessExit(target_action=first, on_exit=[node("registered")])
        )

    return LaunchDescription(
        [
            first,
            GroupAction(
                [
                    PushRosNamespace("arm"),
                    SetParameter("speed", 3),
                    SetParametersFromFile(params),
                    SetRemap("chatter", "/chatter"),
                    SetEnvironmentVariable("DEMO_MODE", "plain"),
                    AppendEnvironmentVariable("DEMO_PATH", "/usr/share"),
                    UnsetEnvironmentVariable("DEMO_GONE"),
                    SetLaunchConfiguration("launch-prefix", "nice -n 3"),
                    SetROSLogDir("/tmp"),
                    node("grouped", emulate_tty=True, output="both"),
                    GroupAction([SetROSLogDir("below"), node("bare")], forwarding=False),
                ]
            ),
            GroupAction([SetEnvironmentVariable("DEMO_LATE", "1")], scoped=False),
            node(
                "options",
                ros_arguments=["--log-level", "debug"],
                arguments=["-v"],
                env={**os.environ, "DEMO_EXTRA": "1"},
                sigterm_timeout="7",
                sigkill_timeout="8",
            ),
            Node(
                package="demo_robot",
                executable="talker",
                exec_name="labelled",
                additional_env={"DEMO_MODE": "plain"},
            ),
            ExecuteProcess(cmd=["sleep", "1000"], name="alone", env={"DEMO_ONLY": "1"}),
            RegisterEventHandler(
                OnExecutionComplete(
                    target_action=first,
                    on_completion=[
                        LogInfo(msg="first has ended"),
                        node("told", arguments=[LocalSubstitution("event.returncode")]),
                        node("completed"),
                    ],
                )
            ),
            RegisterEventHandler(OnProcessStart(on_start=[node("for_any")])),
            OpaqueFunction(function=register),
        ]
    )
