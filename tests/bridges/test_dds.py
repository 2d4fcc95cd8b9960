"""What is DDS's own: the network's configuration, peers, and a robot that dies."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from xml.etree import ElementTree as Xml

import pytest

pytest.importorskip("cyclonedds")

from cyclonedds.builtin import (
    BuiltinDataReader,
    BuiltinTopicDcpsPublication,
    BuiltinTopicDcpsSubscription,
    DcpsEndpoint,
)
from cyclonedds.core import Policy
from cyclonedds.domain import DomainParticipant

from bridges.clock import RealClock
from bridges.messages import TWIST, TWIST_STAMPED, Command, Odometry
from bridges.transports import dds, discovery
from bridges.transports.base import LinkSettings, TransportError
from bridges.transports.dds import DdsEnd, DdsLink
from bridges.transports.dds_network import configuration
from bridges.transports.dds_node import Node
from bridges.transports.discovery import until
from tests.bridges.conftest import LOOPBACK, ROOT, echo_robots

# Nobody is looked for anywhere: no multicast, and not at this machine either.
ALONE = LOOPBACK.replace('<Peers><Peer Address="127.0.0.1"/>', '<Peers AddLocalhost="false">')


def test_without_settings_the_network_is_cyclonedds_own() -> None:
    assert configuration(LinkSettings()) is None


@pytest.mark.parametrize(
    ("interface", "attribute"),
    [("wlan0", "name"), ("192.168.0.5", "address"), ('"<&>', "name")],
)
def test_peers_and_an_interface_are_in_the_configuration(
    interface: str, attribute: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("CYCLONEDDS_URI")

    text = configuration(LinkSettings(interface=interface, peers=["10.0.0.1", "localhost:7411"]))

    root = Xml.fromstring(str(text))
    found = root.find("Domain/General/Interfaces/NetworkInterface")
    assert found is not None
    assert found.attrib == {attribute: interface}
    peers = root.findall("Domain/Discovery/Peers/Peer")
    assert [peer.attrib for peer in peers] == [
        {"Address": "10.0.0.1"},
        {"Address": "127.0.0.1:7411"},
    ]
    assert root.findtext("Domain/Discovery/ParticipantIndex") == "auto"


def test_the_users_configuration_comes_before_ours(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CYCLONEDDS_URI", "file:///etc/cyclonedds.xml")

    text = str(configuration(LinkSettings(peers=["10.0.0.1"])))

    assert text.startswith("file:///etc/cyclonedds.xml,<CycloneDDS>")


def refused(domain: int, **settings: object) -> str:
    link = DdsLink(LinkSettings(domain, connect_timeout=0.2, **settings), RealClock())  # type: ignore[arg-type]
    with pytest.raises(TransportError) as error:
        link.open()
    return str(error.value)


def test_an_unknown_peer_is_refused(domain: int) -> None:
    """CycloneDDS would end the process."""
    words = refused(domain, peers=["nobody.invalid"])

    assert "the peer nobody.invalid has no address" in words


def test_an_unknown_interface_is_refused(domain: int) -> None:
    words = refused(domain, interface="nothing0")

    assert f"does not join domain {domain} with interface=nothing0, CYCLONEDDS_URI" in words


def test_a_process_has_one_configuration_of_a_domain(domain: int) -> None:
    settings = LinkSettings(domain, peers=["127.0.0.1"], connect_timeout=5.0)
    ends: list[DdsEnd | DdsLink] = [
        DdsEnd(settings, RealClock()),
        DdsLink(settings, RealClock()),
    ]
    try:
        for end in ends:
            end.open()  # the same is shared
        assert "is in that domain already" in refused(domain, peers=["127.0.0.2"])
    finally:
        for end in ends:
            end.close()
    assert "no robot was found" in refused(domain, peers=["127.0.0.2"])


def test_a_peer_is_found_where_multicast_does_not_work(
    domain: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CYCLONEDDS_URI", ALONE)
    with echo_robots("dds", domain, ":twist"):
        assert "No topic of anybody was seen" in refused(domain)
        settings = LinkSettings(domain, peers=["localhost"], connect_timeout=10.0)
        link = DdsLink(settings, RealClock())
        link.open()
        link.send(Command(0.1, 0.0))
        assert link.wait(10.0)
        link.close()


def test_others_see_the_names_types_and_qualities_of_ros(domain: int) -> None:
    watcher = DomainParticipant(domain)
    kinds = (BuiltinTopicDcpsPublication, BuiltinTopicDcpsSubscription)
    readers = [BuiltinDataReader(watcher, kind) for kind in kinds]
    robot = DdsEnd(LinkSettings(domain, "lab", command_type="twist"), RealClock())
    robot.open()

    def endpoints() -> list[dict[str, DcpsEndpoint]]:
        read = [[e for e in reader.read(100) if e.topic_name] for reader in readers]
        return [{e.topic_name: e for e in each if e.topic_name[:3] == "rt/"} for each in read]

    assert until(lambda: [len(each) for each in endpoints()] == [1, 2], time.monotonic() + 10)
    published, subscribed = endpoints()
    robot.close()

    assert set(published) == {"rt/lab/odom"}
    assert set(subscribed) == {"rt/lab/cmd_vel", "rt/lab/reset"}
    for endpoint, kind, digest in (
        (published["rt/lab/odom"], "nav_msgs::msg::dds_::Odometry_", "3cc97dc7fb75"),
        (subscribed["rt/lab/cmd_vel"], "geometry_msgs::msg::dds_::Twist_", "9c45bf16fe09"),
        (subscribed["rt/lab/reset"], "std_msgs::msg::dds_::Empty_", "20b625256f32"),
    ):
        assert endpoint.type_name == kind
        assert endpoint.qos[Policy.Userdata].data.startswith(f"typehash=RIHS01_{digest}".encode())
        assert isinstance(endpoint.qos[Policy.Reliability], Policy.Reliability.Reliable)
        assert endpoint.qos[Policy.Durability] is Policy.Durability.Volatile
        assert endpoint.qos[Policy.DataRepresentation].use_cdrv0_representation


def test_only_what_simulates_can_be_reset(domain: int) -> None:
    """A real robot listens to commands alone."""
    robot = Node(LinkSettings(domain), print)
    robot.reader("cmd_vel", TWIST, lambda _: None)
    writer = robot.writer("odom", "nav_msgs/msg/Odometry")
    robot.start()
    link = DdsLink(LinkSettings(domain, connect_timeout=10.0), RealClock())
    link.open()
    with pytest.raises(TransportError, match=r"nobody listens at /reset.* it is gone by now"):
        link.request_reset()
    link.close()
    del writer
    robot.close()


def test_a_message_that_cannot_be_read_is_told_where_odometry_is_taken(
    domain: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> Odometry:
        raise ValueError("no such field")

    monkeypatch.setattr(dds, "odometry_of", fail)
    settings = LinkSettings(domain, "unreadable", connect_timeout=10.0)
    robot, link = DdsEnd(settings, RealClock()), DdsLink(settings, RealClock())
    robot.open()
    link.open()
    robot.publish(Odometry(1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0), (1, 1, 1))
    with pytest.raises(TransportError, match="ValueError: no such field"):
        link.wait(10.0)
    link.send(Command(0.0, 0.0))  # the robot can be stopped all the same
    assert robot.wait(10.0)
    link.close()
    robot.close()


def test_a_robot_that_is_killed_goes_silent_and_blocks_nothing(domain: int) -> None:
    with echo_robots("dds", domain) as process:
        link = DdsLink(LinkSettings(domain, connect_timeout=10.0), RealClock())
        link.open()
        link.send(Command(0.1, 0.0))
        assert link.wait(10.0)
        link.take()
        process.send_signal(signal.SIGKILL)
        process.wait(10)
        began = time.monotonic()
        for _ in range(30):  # DDS still holds it for alive
            link.send(Command(0.1, 0.0))
        assert not link.wait(0.3)
        link.close()

    assert time.monotonic() - began < 10


LEFT_OPEN = """
import sys
from bridges.clock import RealClock
from bridges.transports.base import LinkSettings
from bridges.transports.dds import DdsEnd, DdsLink
settings = LinkSettings(int(sys.argv[1]))
robot, link = DdsEnd(settings, RealClock()), DdsLink(settings, RealClock())
robot.open()
link.open()
raise SystemExit(7)
"""


def test_a_program_ends_that_closes_nothing(domain: int) -> None:
    done = subprocess.run(
        [sys.executable, "-c", LEFT_OPEN, str(domain)],
        check=False,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=30,
    )

    assert (done.returncode, done.stderr) == (7, "")


def test_who_watches_with_another_type_is_told_from_the_robot_by_the_setting(domain: int) -> None:
    robot = DdsEnd(LinkSettings(domain, "watched"), RealClock())
    robot.open()
    watcher = Node(LinkSettings(domain, "watched"), print)
    watcher.reader("cmd_vel", TWIST, lambda _: None)
    watcher.start()
    link = DdsLink(LinkSettings(domain, "watched", connect_timeout=10.0), RealClock())
    with pytest.raises(TransportError) as error:
        link.open()
    settings = LinkSettings(domain, "watched", command_type="twist_stamped", connect_timeout=10.0)
    named = DdsLink(settings, RealClock())
    named.open()
    assert named.command_type == TWIST_STAMPED
    named.close()
    watcher.close()
    robot.close()

    words = str(error.value)
    assert f"both {TWIST} and {TWIST_STAMPED} are taken at /watched/cmd_vel" in words
    assert "command_type=twist" in words


def test_two_robots_of_the_same_name_are_refused(
    domain: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(discovery, "LEASE", 1.0)
    ends = [DdsEnd(LinkSettings(domain, namespace="twins"), RealClock()) for _ in range(2)]
    for end in ends:
        end.open()
    link = DdsLink(LinkSettings(domain, namespace="twins", connect_timeout=1.0), RealClock())
    with pytest.raises(TransportError, match=f"2 robots publish /twins/odom in domain {domain}"):
        link.open()
    ends.pop().close()
    link.open()  # now there is one
    link.close()
    ends.pop().close()
