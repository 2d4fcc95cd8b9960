"""A stand-in for rclpy, to see in which order it is called, and with what.

It is NO proof that the transport works with ROS: nothing here goes over a wire, and it behaves as
its author read rclpy's documentation and source (Humble and Jazzy have the names used). Where
rclpy can be imported, the transports' contract (test_transports.py) runs with the real one.
"""

from __future__ import annotations

import queue
import sys
import threading
from contextlib import suppress
from enum import Enum
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest


class SignalHandlerOptions(Enum):
    NO = 0
    ALL = 3


class ExternalShutdownException(Exception):
    """Of rclpy.executors: somebody else has shut the context down."""


class Ros:
    """A graph of nodes in this process; what is asked of rclpy is written down."""

    def __init__(self) -> None:
        self.calls: list[tuple[Any, ...]] = []
        self.nodes: list[Node] = []
        self.published: list[Any] = []
        self.handlers = SignalHandlerOptions.NO  # that somebody has installed before
        self.remapped: dict[str, str] = {}  # full names of topics; of nodes that begin from now on

    def init(
        self,
        *,
        args: list[str] | None = None,
        context: Any = None,
        domain_id: int | None = None,
        signal_handler_options: SignalHandlerOptions | None = None,
    ) -> None:
        self.calls.append(("init", domain_id, signal_handler_options))
        context.is_ok = True

    def names(self) -> list[Any]:
        """The names of the calls so far."""
        return [call[0] for call in self.calls]

    def other_publisher(self, node: str, kind: type, topic: str) -> Node:
        """A node of somebody else, that publishes at a topic."""
        context = Context(self)
        context.is_ok = True
        namespace, _, name = node.rpartition("/")
        made = Node(name, context=context, namespace=namespace.strip("/") or None)
        made.publishers.append(Publisher(made, kind, topic))
        return made

    def modules(self) -> dict[str, ModuleType]:
        """What can be imported, with this graph behind it."""
        policies = {name: SimpleNamespace(**{v: v for v in values}) for name, values in POLICIES}
        parts: dict[str, dict[str, Any]] = {
            "rclpy": {"init": self.init},
            "rclpy.context": {"Context": lambda: Context(self)},
            "rclpy.duration": {"Duration": lambda seconds: seconds},
            "rclpy.executors": {"SingleThreadedExecutor": Executor},
            "rclpy.node": {"Node": Node},
            "rclpy.qos": {"QoSProfile": lambda **policies: policies, **policies},
            "rclpy.signals": {
                "SignalHandlerOptions": SignalHandlerOptions,
                "get_current_signal_handlers_options": lambda: self.handlers,
            },
            "geometry_msgs.msg": {"Twist": Twist, "TwistStamped": TwistStamped},
            "nav_msgs.msg": {"Odometry": Odometry},
            "std_msgs.msg": {"Empty": Empty},
            "std_srvs.srv": {"Empty": Empty},
        }
        made: dict[str, ModuleType] = {}
        for name, members in parts.items():
            for level in (name.split(".")[0], name):
                made.setdefault(level, ModuleType(level))
            vars(made[name]).update(members)
        return made


POLICIES = (
    ("ReliabilityPolicy", ("RELIABLE", "BEST_EFFORT")),
    ("DurabilityPolicy", ("VOLATILE",)),
    ("HistoryPolicy", ("KEEP_LAST",)),
)


class Context:
    def __init__(self, ros: Ros) -> None:
        self.ros, self.is_ok = ros, False

    def ok(self) -> bool:
        return self.is_ok

    def try_shutdown(self) -> None:
        self.ros.calls.append(("context.try_shutdown",))
        self.is_ok = False


class Executor:
    def __init__(self, *, context: Context) -> None:
        self.context, self.work = context, queue.Queue[Any]()
        self.is_shutdown = False
        self.thread: threading.Thread | None = None

    def add_node(self, node: Node) -> bool:
        node.executor = self
        return True

    def spin_once(self, timeout_sec: float | None = None) -> None:
        assert timeout_sec is not None  # else it may wait for ever
        assert not self.is_shutdown  # else guard conditions may be gone under it
        thread = threading.current_thread()
        call = ("spin", thread.daemon, thread is threading.main_thread())
        if thread is not self.thread:
            self.thread = thread
            self.context.ros.calls.append(call)
        if not self.context.ok():
            raise ExternalShutdownException
        with suppress(queue.Empty):
            self.work.get(timeout=timeout_sec)()  # what a callback raises comes out here

    def shutdown(self, timeout_sec: float | None = None) -> bool:
        self.context.ros.calls.append(("executor.shutdown",))
        assert self.thread is None or not self.thread.is_alive()
        self.is_shutdown = True
        return True


class Publisher:
    def __init__(self, node: Node, kind: type, topic: str) -> None:
        self.node, self.kind, self.topic = node, kind, topic
        self.reliability = "RELIABLE"

    def publish(self, message: Any) -> None:
        assert isinstance(message, self.kind)
        ros = self.node.context.ros
        ros.published.append(message)
        for callback, node in self._subscriptions():
            node.executor.work.put(lambda call=callback: call(message))

    def _subscriptions(self) -> list[tuple[Any, Node]]:
        return [
            (callback, node)
            for node in self.node.context.ros.nodes
            for kind, topic, callback in node.subscribed
            if (kind, topic) == (self.kind, self.topic)
        ]

    def get_subscription_count(self) -> int:
        return len(self._subscriptions())

    def wait_for_all_acked(self, timeout: float = -1) -> bool:
        self.node.context.ros.calls.append(("wait_for_all_acked", timeout))
        raise NotImplementedError("this middleware cannot")


class Node:
    executor: Executor

    def __init__(
        self,
        node_name: str,
        *,
        context: Context,
        namespace: str | None = None,
        start_parameter_services: bool = True,
    ) -> None:
        assert context.ok()
        self.name = node_name
        self.context, self.namespace = context, f"/{namespace}" if namespace else ""
        self.publishers: list[Publisher] = []
        self.subscribed: list[tuple[type, str, Any]] = []
        self.services: dict[str, Any] = {}
        self.remapped = dict(context.ros.remapped)
        context.ros.calls.append(("node", node_name, namespace))
        context.ros.nodes.append(self)

    def create_publisher(self, msg_type: type, topic: str, qos_profile: Any) -> Publisher:
        self._check(qos_profile)
        self.publishers.append(Publisher(self, msg_type, self.resolve_topic_name(topic)))
        return self.publishers[-1]

    def create_subscription(
        self, msg_type: type, topic: str, callback: Any, qos_profile: Any
    ) -> None:
        self._check(qos_profile)
        self.subscribed.append((msg_type, self.resolve_topic_name(topic), callback))

    def create_service(self, srv_type: type, srv_name: str, callback: Any) -> None:
        self.services[f"{self.namespace}/{srv_name}"] = callback

    def _check(self, profile: dict[str, Any]) -> None:
        assert profile == {
            "history": "KEEP_LAST",
            "depth": 10,
            "reliability": "RELIABLE",
            "durability": "VOLATILE",
        }

    def resolve_topic_name(self, topic: str) -> str:
        full = self._expanded(topic)
        return self.remapped.get(full, full)

    def _expanded(self, topic: str) -> str:
        return topic if topic.startswith("/") else f"{self.namespace}/{topic}"

    def get_fully_qualified_name(self) -> str:
        return f"{self.namespace}/{self.name}"

    def get_publishers_info_by_topic(self, topic_name: str) -> list[Any]:
        return [
            SimpleNamespace(
                node_name=node.name,
                node_namespace=node.namespace or "/",
                topic_type=publisher.kind.ros_type,  # type: ignore[attr-defined]
                qos_profile=SimpleNamespace(reliability=publisher.reliability),
            )
            for node in self.context.ros.nodes
            for publisher in node.publishers
            if publisher.topic == self._expanded(topic_name)
        ]

    def get_subscriptions_info_by_topic(self, topic_name: str) -> list[Any]:
        return [
            SimpleNamespace(topic_type=kind.ros_type)  # type: ignore[attr-defined]
            for node in self.context.ros.nodes
            for kind, topic, _ in node.subscribed
            if topic == self._expanded(topic_name)
        ]

    def get_topic_names_and_types(self) -> list[tuple[str, list[str]]]:
        topics: dict[str, list[str]] = {}
        for node in self.context.ros.nodes:
            for publisher in node.publishers:
                topics[publisher.topic] = [publisher.kind.ros_type]  # type: ignore[attr-defined]
            for kind, topic, _ in node.subscribed:
                topics[topic] = [kind.ros_type]  # type: ignore[attr-defined]
        return list(topics.items())

    def get_clock(self) -> Any:
        return SimpleNamespace(now=lambda: SimpleNamespace(to_msg=lambda: Time(sec=7)))

    def destroy_node(self) -> None:
        self.context.ros.calls.append(("destroy_node",))
        self.context.ros.nodes.remove(self)


class Message:
    """Takes what rclpy takes where it checks fields: the very type, and known names."""

    ros_type = ""

    def __init__(self, **values: Any) -> None:
        for name, value in {**{n: make() for n, make in self.fields()}, **values}.items():
            object.__setattr__(self, name, value)

    @classmethod
    def fields(cls) -> list[tuple[str, Any]]:
        return list(cls.__annotations__.items()) if hasattr(cls, "__annotations__") else []

    def __setattr__(self, name: str, value: Any) -> None:
        kind = type(getattr(self, name))
        assert type(value) is kind, f"{name} must be {kind}, not {type(value)}"
        if kind is list:
            assert len(value) == 36
            assert {type(item) for item in value} == {float}
        object.__setattr__(self, name, value)


def message(ros_type: str = "", **fields: Any) -> type:
    """A class of messages, with what makes each field's default."""
    return type("M", (Message,), {"ros_type": ros_type, "__annotations__": fields})


Time = message(sec=int, nanosec=int)
Header = message(stamp=Time, frame_id=str)
Vector3 = message(x=float, y=float, z=float)
Quaternion = message(x=float, y=float, z=float, w=lambda: 1.0)
Pose = message(position=Vector3, orientation=Quaternion)
PoseWithCovariance = message(pose=Pose, covariance=lambda: [0.0] * 36)
Twist = message("geometry_msgs/msg/Twist", linear=Vector3, angular=Vector3)
TwistStamped = message("geometry_msgs/msg/TwistStamped", header=Header, twist=Twist)
TwistWithCovariance = message(twist=Twist, covariance=lambda: [0.0] * 36)
Odometry = message(
    "nav_msgs/msg/Odometry",
    header=Header,
    child_frame_id=str,
    pose=PoseWithCovariance,
    twist=TwistWithCovariance,
)
Empty = message("std_msgs/msg/Empty")


def install(patch: pytest.MonkeyPatch) -> Ros:
    """Makes the stand-in what `import rclpy` finds, as long as the patch lasts."""
    ros = Ros()
    for name in ("ros", "ros_session"):
        patch.delitem(sys.modules, f"bridges.transports.{name}", raising=False)
    for name, module in ros.modules().items():
        patch.setitem(sys.modules, name, module)
    return ros
