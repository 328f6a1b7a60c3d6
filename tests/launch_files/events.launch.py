"""Processes, events, timers, respawn, and the end of all."""

from launch import LaunchDescription
from launch.actions import (
    EmitEvent,
    ExecuteProcess,
    LogInfo,
    RegisterEventHandler,
    Shutdown,
    TimerAction,
)
from launch.event_handlers import OnProcessExit, OnProcessIO, OnProcessStart, OnShutdown
from launch.events import Shutdown as ShutdownEvent
from launch_ros.actions import Node


def generate_launch_description():
    spawner = ExecuteProcess(cmd=["sh", "-c", "sleep 0.2"], name="spawner")
    main = Node(
        package="demo_robot",
        executable="talker",
        name="main",
        on_exit=Shutdown(reason="main has ended"),
    )
    follower = Node(package="demo_robot", executable="talker", name="follower")
    return LaunchDescription(
        [
            spawner,
            main,
            ExecuteProcess(cmd=["echo $HOME", "; sleep 1000"], shell=True, name="shell"),
            RegisterEventHandler(OnProcessExit(target_action=spawner, on_exit=[follower])),
            RegisterEventHandler(
                OnProcessStart(
                    target_action=follower,
                    on_start=[
                        TimerAction(
                            period=0.5,
                            actions=[
                                Node(
                                    package="demo_robot",
                                    executable="talker",
                                    name="last",
                                    respawn=True,
                                    respawn_max_retries=3,
                                    sigterm_timeout="2",
                                ),
                            ],
                        ),
                    ],
                )
            ),
            TimerAction(
                period=1.0,
                actions=[
                    LogInfo(msg="late"),
                    Node(package="demo_robot", executable="talker", name="late"),
                ],
            ),
            RegisterEventHandler(OnProcessIO(target_action=main, on_stdout=lambda event: None)),
            RegisterEventHandler(
                OnProcessExit(target_action=main, on_exit=lambda event, context: [])
            ),
            RegisterEventHandler(OnShutdown(on_shutdown=[LogInfo(msg="bye")])),
            TimerAction(period=60.0, actions=[EmitEvent(event=ShutdownEvent())]),
        ]
    )
