"""Lifecycle nodes and their transitions."""

from launch import LaunchDescription
from launch.actions import EmitEvent, RegisterEventHandler
from launch.events import matches_action
from launch_ros.actions import LifecycleNode, LifecycleTransition, Node
from launch_ros.event_handlers import OnStateTransition
from launch_ros.events.lifecycle import ChangeState
from lifecycle_msgs.msg import Transition


def generate_launch_description():
    driver = LifecycleNode(
        package="demo_robot",
        executable="talker",
        name="driver",
        namespace="robot",
        parameters=[{"rate": 20}],
    )
    map_server = LifecycleNode(package="demo_robot", executable="talker", name="maps", namespace="")
    activate = EmitEvent(
        event=ChangeState(
            lifecycle_node_matcher=matches_action(driver),
            transition_id=Transition.TRANSITION_ACTIVATE,
        )
    )
    return LaunchDescription(
        [
            driver,
            map_server,
            EmitEvent(
                event=ChangeState(
                    lifecycle_node_matcher=matches_action(driver),
                    transition_id=Transition.TRANSITION_CONFIGURE,
                )
            ),
            RegisterEventHandler(
                OnStateTransition(
                    target_lifecycle_node=driver,
                    goal_state="inactive",
                    entities=[activate],
                )
            ),
            LifecycleTransition(
                lifecycle_node_names=["/maps"],
                transition_ids=[
                    Transition.TRANSITION_CONFIGURE,
                    Transition.TRANSITION_INACTIVE_SHUTDOWN,
                ],
            ),
            RegisterEventHandler(
                OnStateTransition(
                    target_lifecycle_node=driver,
                    goal_state="active",
                    entities=[Node(package="demo_robot", executable="talker", name="planner")],
                )
            ),
            RegisterEventHandler(
                OnStateTransition(
                    target_lifecycle_node=driver,
                    goal_state="finalized",
                    entities=[Node(package="demo_robot", executable="talker", name="never")],
                )
            ),
            LifecycleNode(
                package="demo_robot", executable="talker", name="waiting", namespace="robot"
            ),
            Node(package="demo_robot", executable="talker", name="plain"),
        ]
    )
