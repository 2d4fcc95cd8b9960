"""Finding a robot, with a graph that is told instead of seen."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Sequence

import pytest

from bridges.messages import TWIST, TWIST_STAMPED
from bridges.transports import names
from bridges.transports.base import LinkSettings, TransportError
from bridges.transports.discovery import LEASE, Seen, find_robot

SETTINGS = LinkSettings(connect_timeout=0.3)


def seen(
    *types: str, odometry: int = 1, topics: int = 0, drivers: Sequence[str] = ()
) -> Callable[[], Seen]:
    listed = {f"/topic{i:02}": "std_msgs/msg/String" for i in range(topics)}
    listed["/rosout"] = "rcl_interfaces/msg/Log"
    return lambda: Seen(set(types), odometry, listed, drivers)


def refused(look: Callable[[], Seen], settings: LinkSettings = SETTINGS) -> str:
    with pytest.raises(TransportError) as error:
        find_robot(look, settings, "domain 7", settle=0.05, lease=0.1)
    return str(error.value)


def test_an_endpoint_that_shows_later_counts() -> None:
    """Both types are there in the end, the second one a moment after the first."""
    began = time.monotonic()

    def look() -> Seen:
        late = time.monotonic() - began > 0.05
        return seen(TWIST, TWIST_STAMPED)() if late else seen(TWIST)()

    with pytest.raises(TransportError, match="not clear which"):
        find_robot(look, SETTINGS, "domain 7", settle=0.15)


def test_a_robot_that_comes_later_is_found() -> None:
    began = time.monotonic()
    here, away = seen(TWIST), seen()

    found = find_robot(lambda: here() if time.monotonic() - began > 0.1 else away(), SETTINGS, "")

    assert found == TWIST


def test_the_wanted_type_is_taken_where_both_are() -> None:
    settings = LinkSettings(command_type="twist")

    assert find_robot(seen(TWIST, TWIST_STAMPED), settings, "", settle=0.05) == TWIST


def test_somebody_who_watches_with_another_type_does_not_confuse() -> None:
    assert find_robot(seen(TWIST, "std_msgs/msg/String"), SETTINGS, "", settle=0.05) == TWIST


def test_a_robot_without_odometry_is_none() -> None:
    words = refused(seen(TWIST, odometry=0))

    assert "nobody publishes nav_msgs/msg/Odometry at /odom in domain 7" in words


def test_two_robots_are_refused_by_the_topic_and_the_domain() -> None:
    words = refused(seen(TWIST, odometry=2), LinkSettings(namespace="lab", connect_timeout=0.1))

    assert "2 robots publish /lab/odom in domain 7" in words
    assert "link.namespace" in words


@pytest.mark.parametrize(
    ("crowded", "words"),
    [
        (seen(TWIST, odometry=2), "2 robots publish /odom in domain 7. Who was killed"),
        (seen(TWIST, drivers=["python"]), "at /cmd_vel in domain 7: python. Who was killed"),
    ],
)
def test_who_was_killed_is_waited_for_longer_than_a_robot_and_told_once(
    crowded: Callable[[], Seen], words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    settings, began = LinkSettings(connect_timeout=0.05), time.monotonic()

    def look() -> Seen:
        return (crowded if time.monotonic() - began < 0.3 else seen(TWIST))()

    assert find_robot(look, settings, "domain 7", settle=0.05, lease=60.0) == TWIST
    assert 0.3 < time.monotonic() - began < 10
    (told,) = capsys.readouterr().out.splitlines()
    assert words in told
    assert told.endswith("waiting for up to 60 s")


def test_who_is_there_longer_than_the_dead_is_refused() -> None:
    began = time.monotonic()

    words = refused(seen(TWIST, drivers=["node /teleop (geometry_msgs/msg/Twist)"]))

    assert time.monotonic() - began >= 0.1
    assert "commanded by others at /cmd_vel in domain 7: node /teleop (geometry_msgs" in words
    assert "End them" in words
    assert "commands:=TOPIC" in words  # of a mixer


def test_who_commands_no_robot_does_not_hide_that_there_is_none() -> None:
    assert "no robot was found" in refused(seen(TWIST, odometry=0, drivers=["python"]))


def test_the_dead_are_waited_for_as_long_as_fast_dds_and_cyclonedds_show_them() -> None:
    assert LEASE > 20.0


def test_a_type_that_the_bridge_does_not_send_is_named() -> None:
    words = refused(seen("geometry_msgs/msg/Vector3"))

    assert "geometry_msgs/msg/Vector3 is taken at /cmd_vel" in words


def test_where_no_topic_is_seen_the_network_is_asked_about() -> None:
    words = refused(seen())

    assert "No topic of anybody was seen" in words
    assert "ROS_DOMAIN_ID" in words
    assert "link.peers" in words
    assert "rosout" not in words
    assert "python -m bridges.sim_turtlebot" in words


def test_topics_that_are_seen_are_listed_some_of_them() -> None:
    words = refused(seen(topics=25))

    assert len(re.findall(r"/topic\d\d \(std_msgs/msg/String\)", words)) == 20
    assert "and 5 more" in words
    assert "namespace" in words


def test_the_domain_is_the_settings_or_the_environments(monkeypatch: pytest.MonkeyPatch) -> None:
    assert names.domain_id(LinkSettings()) == 0
    monkeypatch.setenv("ROS_DOMAIN_ID", "30")
    assert names.domain_id(LinkSettings()) == 30
    assert names.domain_id(LinkSettings(domain_id=0)) == 0
    monkeypatch.setenv("ROS_DOMAIN_ID", "")
    assert names.domain_id(LinkSettings()) == 0
    for wrong in ("233", "-1", "one"):
        monkeypatch.setenv("ROS_DOMAIN_ID", wrong)
        with pytest.raises(TransportError, match=f"ROS_DOMAIN_ID={wrong}"):
            names.domain_id(LinkSettings())


def test_topics_are_in_the_namespace() -> None:
    assert names.topic(LinkSettings(), "odom") == "/odom"
    for given in ("lab/robot1", "/lab/robot1", "/lab/robot1/"):
        assert names.topic(LinkSettings(namespace=given), "odom") == "/lab/robot1/odom"
    for wrong in ("1robot", "a b", "a//b", "a-b", "a/1"):
        with pytest.raises(TransportError, match=f"namespace={wrong} is not allowed"):
            names.topic(LinkSettings(namespace=wrong), "odom")
