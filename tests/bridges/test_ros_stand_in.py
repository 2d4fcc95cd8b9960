"""How the transport over rclpy calls it, with a stand-in that is no proof of the wire."""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from bridges.clock import RealClock
from bridges.messages import TWIST, TWIST_STAMPED, Command, Odometry
from bridges.transports import choice, discovery
from bridges.transports.base import LinkSettings, TransportError
from tests.bridges import rclpy_stand_in

LIMIT = 5.0


@pytest.fixture
def ros(monkeypatch: pytest.MonkeyPatch) -> Iterator[rclpy_stand_in.Ros]:
    with monkeypatch.context() as patch:
        yield rclpy_stand_in.install(patch)
    # what was imported meanwhile has the stand-in inside
    for name in ("ros", "ros_session"):
        sys.modules.pop(f"bridges.transports.{name}", None)
        vars(sys.modules["bridges.transports"]).pop(name, None)


def ends(**settings: Any) -> tuple[Any, Any]:
    made = LinkSettings(7, connect_timeout=LIMIT, **settings)
    robot, link = choice.end("auto", made, RealClock()), choice.link("auto", made, RealClock())
    robot.open()
    return link, robot


def test_nodes_have_contexts_of_their_own_and_take_no_signals(ros: rclpy_stand_in.Ros) -> None:
    link, robot = ends(namespace="/lab/")
    link.open()
    link.close()
    robot.close()

    no = rclpy_stand_in.SignalHandlerOptions.NO
    assert [call for call in ros.calls if call[0] == "init"] == [("init", 7, no)] * 2
    names = [call[1:] for call in ros.calls if call[0] == "node"]
    assert names == [("emrld_sim_turtlebot", "lab"), ("emrld_bridge", "lab")]
    spins = [call for call in ros.calls if call[0] == "spin"]
    assert spins == [("spin", True, False)] * 2  # a daemon thread, not the main one


def test_what_uses_ends_before_what_is_used(ros: rclpy_stand_in.Ros) -> None:
    link, robot = ends()
    robot.close()
    robot.close()
    before = len(ros.calls)
    assert ros.names()[-3:] == ["executor.shutdown", "destroy_node", "context.try_shutdown"]
    assert "wait_for_all_acked" in ros.names()[:-3]
    link.close()  # was never open
    assert len(ros.calls) == before
    assert not ros.nodes
    assert not [t for t in threading.enumerate() if t.name.startswith("emrld")]


@pytest.mark.parametrize(
    ("given", "kind"),
    [("auto", TWIST_STAMPED), ("twist_stamped", TWIST_STAMPED), ("twist", TWIST)],
)
def test_messages_pass_with_every_field_of_its_type(
    ros: rclpy_stand_in.Ros, given: str, kind: str
) -> None:
    link, robot = ends(command_type=given)
    link.open()
    assert link.command_type == kind
    quarter: Any = np.float32(0.25)
    link.send(Command(quarter, 1))
    assert robot.wait(LIMIT)
    assert list(robot.take_commands()) == [Command(0.25, 1.0)]
    if kind == TWIST_STAMPED:
        assert ros.published[-1].header.stamp.sec == 7  # the node's clock
    robot.publish(Odometry(2.5, 0.0, np.float64(1), 2, -0.5, 0, 0, "a", "b"), (1, 2, 3))
    assert link.wait(LIMIT)
    taken = link.take()[0]
    assert taken._replace(received=0.0, theta=round(taken.theta, 12)) == Odometry(
        2.5, 0.0, 1.0, 2.0, -0.5, 0.0, 0.0, "a", "b"
    )
    link.close()
    robot.close()


def test_a_robot_is_reset_by_message_and_by_service(ros: rclpy_stand_in.Ros) -> None:
    link, robot = ends(namespace="lab")
    link.open()
    link.request_reset()
    assert robot.wait(LIMIT)
    response = object()
    assert ros.nodes[0].services["/lab/reset_simulation"](object(), response) is response
    assert robot.take_resets() == 2
    link.close()
    robot.close()


def test_a_robot_is_reset_by_message_where_there_are_no_services_types(
    ros: rclpy_stand_in.Ros, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "std_srvs.srv", None)
    link, robot = ends()
    assert ros.nodes[0].services == {}
    link.open()
    link.request_reset()
    assert robot.wait(LIMIT)
    assert robot.take_resets() == 1
    link.close()
    robot.close()


def test_nobody_and_another_type_are_told(ros: rclpy_stand_in.Ros) -> None:
    _, robot = ends(command_type="twist")
    for settings, words in (
        (LinkSettings(7, "x", connect_timeout=0.1), r"/cmd_vel \(geometry_msgs/msg/Twist\)"),
        (LinkSettings(7, command_type="twist_stamped", connect_timeout=0.1), "the robot takes"),
    ):
        link = choice.link("rclpy", settings, RealClock())
        with pytest.raises(TransportError, match=words):
            link.open()
    robot.close()
    assert not ros.nodes


def test_topics_may_be_remapped(ros: rclpy_stand_in.Ros) -> None:
    ros.remapped = {"/lab/odom": "/wheels", "/lab/cmd_vel": "/lab/drive"}
    robot = choice.end("rclpy", LinkSettings(7, "lab"), RealClock())
    robot.open()
    link = choice.link("rclpy", LinkSettings(7, "lab", connect_timeout=LIMIT), RealClock())
    link.open()
    link.send(Command(0.1, 0.0))
    assert robot.wait(LIMIT)
    robot.publish(Odometry(1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0), (1, 1, 1))
    assert link.wait(LIMIT)
    link.close()
    robot.close()


def test_odometry_by_best_effort_is_told(ros: rclpy_stand_in.Ros) -> None:
    link, robot = ends()
    (publisher,) = (p for p in ros.nodes[0].publishers if p.topic == "/odom")
    publisher.reliability = "BEST_EFFORT"
    with pytest.raises(TransportError, match="publishes /odom by best effort"):
        link.open()
    publisher.reliability = "RELIABLE"
    link.open()
    link.close()
    robot.close()


def test_a_robot_that_cannot_be_reset_is_told(ros: rclpy_stand_in.Ros) -> None:
    link, robot = ends()
    ros.nodes[0].subscribed[:1] = []
    link.open()
    with pytest.raises(TransportError, match=r"nobody listens at /reset.* it is gone by now"):
        link.request_reset()
    link.close()
    robot.close()


def test_what_the_middleware_does_not_send_is_told(
    ros: rclpy_stand_in.Ros, monkeypatch: pytest.MonkeyPatch
) -> None:
    link, robot = ends()
    link.open()

    def fail(*_: Any) -> None:
        raise RuntimeError("Failed to publish")  # what rclpy's RCLError is

    monkeypatch.setattr(rclpy_stand_in.Publisher, "publish", fail)
    for send in (
        lambda: link.send(Command(0.1, 0.0)),
        link.request_reset,
        lambda: robot.publish(Odometry(1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0), (1, 1, 1)),
    ):
        with pytest.raises(TransportError, match="could not be sent: Failed to publish"):
            send()
    link.close()
    robot.close()


def test_a_callback_that_fails_is_told_where_odometry_is_taken(
    ros: rclpy_stand_in.Ros, monkeypatch: pytest.MonkeyPatch
) -> None:
    link, robot = ends()
    link.open()

    def fail(*_: Any) -> Odometry:
        raise ValueError("no such field")

    with monkeypatch.context() as patch:
        patch.setattr(sys.modules["bridges.transports.ros"], "odometry_of", fail)
        robot.publish(Odometry(1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0), (1, 1, 1))
        for receive in (lambda: link.wait(60.0), link.take):
            with pytest.raises(TransportError, match="ValueError: no such field"):
                receive()
    link.send(Command(0.0, 0.0))  # the robot can be stopped all the same
    assert robot.wait(LIMIT)

    link.open()
    assert list(link.take()) == []
    link.close()
    robot.close()


def test_a_context_that_others_shut_down_is_told(ros: rclpy_stand_in.Ros) -> None:
    link, robot = ends()
    link.open()
    ros.nodes[-1].context.is_ok = False
    with pytest.raises(TransportError, match=r"ExternalShutdown.*SignalHandlerOptions\.NO"):
        link.wait(60.0)
    link.close()
    robot.close()


def test_signal_handlers_that_would_end_the_link_too_early_are_told(
    ros: rclpy_stand_in.Ros,
) -> None:
    link, robot = ends()
    ros.handlers = rclpy_stand_in.SignalHandlerOptions.ALL
    with pytest.warns(RuntimeWarning, match=r"signal_handler_options=.*SignalHandlerOptions\.NO"):
        link.open()
    link.close()
    robot.close()


@pytest.mark.parametrize(
    ("node", "kind", "words"),
    [
        ("/teleop", rclpy_stand_in.Twist, "node /teleop (geometry_msgs/msg/Twist)"),
        ("/lab/emrld_bridge", rclpy_stand_in.TwistStamped, "node /lab/emrld_bridge ("),
        ("/_CREATED_BY_BARE_DDS_APP_", rclpy_stand_in.TwistStamped, "a program without a name in"),
    ],
)
def test_who_else_publishes_commands_is_refused_and_seen_later(
    ros: rclpy_stand_in.Ros, monkeypatch: pytest.MonkeyPatch, node: str, kind: type, words: str
) -> None:
    """A second bridge too, whose node has our name."""
    monkeypatch.setattr(discovery, "LEASE", 0.05)
    link, robot = ends(namespace="lab")
    link.open()
    assert list(link.others()) == []
    other = ros.other_publisher(node, kind, "/lab/cmd_vel")
    (seen,) = link.others()
    assert words in seen
    with pytest.raises(TransportError, match="commanded by others at /lab/cmd_vel") as error:
        link.open()
    assert words in str(error.value)
    before = len(ros.nodes)
    link.open(drives=False)  # a dry run: others may, and see nobody beside them
    assert list(link.others()) == []
    assert [each.topic for each in ros.nodes[before].publishers] == ["/lab/reset"]
    with pytest.raises(TransportError, match="listen only"):
        link.send(Command(0.1, 0.0))
    other.destroy_node()
    link.open()
    link.send(Command(0.1, 0.0))
    link.close()
    robot.close()


def test_behind_a_relay_only_its_input_is_looked_at(ros: rclpy_stand_in.Ros) -> None:
    """The node deadman takes cmd_vel_in, which the bridge publishes then, and publishes cmd_vel."""
    robot = choice.end("rclpy", LinkSettings(7), RealClock())
    robot.open()
    deadman = ros.other_publisher("/emrld_deadman", rclpy_stand_in.TwistStamped, "/cmd_vel")
    received: list[Any] = []
    deadman.subscribed.append((rclpy_stand_in.TwistStamped, "/cmd_vel_in", received.append))
    deadman.executor = ros.nodes[0].executor
    ros.remapped = {"/cmd_vel": "/cmd_vel_in"}
    link = choice.link("rclpy", LinkSettings(7, connect_timeout=LIMIT), RealClock())
    link.open()
    assert list(link.others()) == []
    ros.other_publisher("/teleop", rclpy_stand_in.Twist, "/cmd_vel_in")
    assert list(link.others()) == ["node /teleop (geometry_msgs/msg/Twist)"]
    link.close()
    robot.close()


def test_a_graph_that_cannot_be_read_is_told(
    ros: rclpy_stand_in.Ros, monkeypatch: pytest.MonkeyPatch
) -> None:
    link, robot = ends()
    link.open()

    def fail(*_: Any) -> None:
        raise RuntimeError("invalid handle")

    monkeypatch.setattr(rclpy_stand_in.Node, "get_publishers_info_by_topic", fail)
    with pytest.raises(TransportError, match="graph cannot be read: invalid handle"):
        link.others()
    link.close()
    robot.close()


def test_what_only_dds_has_is_refused(ros: rclpy_stand_in.Ros) -> None:
    for settings in (LinkSettings(peers=["10.0.0.1"]), LinkSettings(interface="wlan0")):
        with pytest.raises(TransportError, match="are for robot=dds"):
            choice.link("rclpy", settings, RealClock()).open()
    assert not ros.calls


def test_a_ros_that_does_not_start_is_told(
    ros: rclpy_stand_in.Ros, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(**_: Any) -> None:
        raise RuntimeError("no middleware")

    monkeypatch.setattr(sys.modules["rclpy"], "init", fail)
    with pytest.raises(TransportError, match="rclpy does not join domain 7: no middleware"):
        ends()
    assert ros.names() == ["context.try_shutdown"]


def test_two_robots_of_the_same_name_are_refused(
    ros: rclpy_stand_in.Ros, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(discovery, "LEASE", 0.1)
    settings = LinkSettings(7, connect_timeout=0.3)
    robots = [choice.end("auto", settings, RealClock()) for _ in range(2)]
    for robot in robots:
        robot.open()
    link = choice.link("auto", settings, RealClock())
    with pytest.raises(TransportError, match="2 robots publish /odom in domain 7"):
        link.open()
    for robot in robots:
        robot.close()
