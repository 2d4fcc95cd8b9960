"""The node `emrld_run`: bridges.run, its settings as parameters, its questions as a service."""

from __future__ import annotations

import sys
import threading
from contextlib import AbstractContextManager
from typing import Any

import rclpy
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from std_srvs.srv import Trigger

from bridges import people
from bridges.command_line import run_command
from bridges.run import run
from bridges.run_settings import RunConfig

from .parameters import config_of, parameters

NAME = "emrld_run"
SERVICE = "~/go_on"


def main() -> None:
    """Drives as the parameters say, and exits."""
    run_command(_main)


def _main() -> int:
    with RunNode() as node:
        return run(node.config(), people.ask if sys.stdin.isatty() else node.ask)


class RunNode(AbstractContextManager):
    """Shows parameters, and answers the service, while a robot is driven beside it.

    The robot is driven through a node of its own (bridges.transports.ros). No signal handler is
    taken over here either: bridges.run stops the robot on signals.
    """

    def __init__(self) -> None:
        self._context = Context()
        rclpy.init(
            args=sys.argv, context=self._context, signal_handler_options=SignalHandlerOptions.NO
        )
        self._node = Node(NAME, context=self._context)
        for name, default, description in parameters():
            # dynamic, so that 5 may stand for 5.0; the settings' own check follows
            about = ParameterDescriptor(
                description=description, read_only=True, dynamic_typing=True
            )
            self._node.declare_parameter(name, default, about)
        self._asked, self._answered = False, threading.Event()
        self._node.create_service(Trigger, SERVICE, self._answer)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._thread = threading.Thread(target=self._spin, name=NAME, daemon=True)
        self._closing = False

    def __enter__(self) -> RunNode:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._closing = True
        self._thread.join()
        self._executor.shutdown()
        self._node.destroy_node()
        self._context.try_shutdown()

    def config(self) -> RunConfig:
        """The settings that the parameters give.

        Raises:
            SettingError: names what is wrong and what is allowed.
        """
        return config_of({p.name: self._node.get_parameter(p.name).value for p in parameters()})

    def ask(self, question: str) -> None:
        """Waits for a call of the service: what ros2 launch starts has no keyboard."""
        name = f"{self._node.get_fully_qualified_name()}/go_on"
        print(f"{question}\nros2 service call {name} std_srvs/srv/Trigger goes on", flush=True)
        # a call before the question answers nothing
        self._answered.clear()
        self._asked = True
        self._answered.wait()

    def _answer(self, _: Any, response: Any) -> Any:
        response.success, self._asked = self._asked, False
        response.message = "it goes on" if response.success else "nothing was asked"
        if response.success:
            self._answered.set()
        return response

    def _spin(self) -> None:
        """Not by `spin`: see bridges.transports.ros."""
        while not self._closing:
            self._executor.spin_once(timeout_sec=0.1)
