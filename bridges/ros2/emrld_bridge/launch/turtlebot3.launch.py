"""Drives a TurtleBot3: ros2 launch emrld_bridge turtlebot3.launch.py bundle:=policy.safetensors"""

from __future__ import annotations

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction, Shutdown
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

# Arguments that stand for a parameter: what the argument is called, the parameter, what it means.
# Where one is not given, the file of parameters counts.
ARGUMENTS = (
    ("bundle", "bundle", "the policy: a file of emrld_jax.export"),
    ("mode", "mode", "collect, adapt, execute or all"),
    ("episodes", "episodes", "whole episodes to collect, and to execute"),
    ("out", "out", "folder for recordings, adapted policies, picture and summary"),
    ("reset", "reset", "ask: a person puts the robot back; service: a simulator does"),
    ("yes", "yes", "true: nobody need confirm that the robot may move"),
    ("dry_run", "dry_run", "true: publish nothing, the robot does not move"),
    ("namespace", "link.namespace", "of the robot's topics"),
    (
        "residual_angular_velocity",
        "residual_angular_velocity",
        "rad a control period that are added to the policy's turns",
    ),
)


def generate_launch_description() -> LaunchDescription:
    """The node, and the arguments that it is started with."""
    file = Path(get_package_share_directory("emrld_bridge"), "config", "parameters.yaml")
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                "parameters", default_value=str(file), description="file of all parameters"
            ),
            DeclareLaunchArgument(
                "commands",
                default_value="cmd_vel",
                description="topic of commands; cmd_vel_in where a deadman node passes them on",
            ),
            *(
                DeclareLaunchArgument(
                    name, default_value="", description=f"{meaning}; empty: as the file says"
                )
                for name, _, meaning in ARGUMENTS
            ),
            OpaqueFunction(function=_start),
        ]
    )


def _start(context: LaunchContext) -> list[Node]:
    """The node with the parameters that were given; the rest is as the file says."""
    given = {
        parameter: ParameterValue(LaunchConfiguration(name), value_type=str)
        for name, parameter, _ in ARGUMENTS
        if LaunchConfiguration(name).perform(context)
    }
    return [
        Node(
            package="emrld_bridge",
            executable="run",
            output="screen",
            # Nothing names the node: the one that drives the robot would be called the same.
            parameters=[LaunchConfiguration("parameters"), *([given] if given else [])],
            remappings=[("cmd_vel", LaunchConfiguration("commands"))],
            on_exit=[Shutdown(reason="bridges.run has ended")],
        )
    ]
