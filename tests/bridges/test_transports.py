"""The contract of a transport, the same for all: a link, and echoing robots at the other end.

Over DDS and rclpy the robots are in a process of their own.
"""

from __future__ import annotations

import math
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.bridge_latency import round_trips
from benchmarks.echo_robot import echo
from bridges.clock import RealClock
from bridges.messages import TWIST, TWIST_STAMPED, Command, Odometry
from bridges.transports import choice, discovery
from bridges.transports.base import LinkSettings, RobotLink, TransportError
from bridges.transports.memory import MemoryEnd
from tests.bridges.conftest import echo_robots

# where the robots are, and what they take
ROBOTS = (":twist_stamped", "other:twist", "twins:twist", "twins:twist_stamped")
LIMIT = 5.0  # s that nothing here may take; mostly it is some ms


@contextmanager
def echoing_threads(domain: int) -> Iterator[None]:
    over = threading.Event()
    ends, threads = [], []
    for namespace, kind in (robot.split(":") for robot in ROBOTS):
        settings = LinkSettings(domain, namespace, command_type=kind)
        ends.append(MemoryEnd(settings, RealClock()))
        ends[-1].open()
        arguments = (ends[-1], lambda: not over.is_set())
        threads.append(threading.Thread(target=echo, args=arguments, daemon=True))
        threads[-1].start()
    yield
    over.set()
    for thread, end in zip(threads, ends, strict=True):
        thread.join(LIMIT)
        end.close()


@pytest.fixture(scope="module", params=["memory", "dds", "rclpy"])
def transport(request: pytest.FixtureRequest, domain: int) -> Iterator[str]:
    """A transport with its robots."""
    name = str(request.param)
    if name == "memory":
        with echoing_threads(domain):
            yield name
    else:
        pytest.importorskip({"dds": "cyclonedds"}.get(name, name))
        with echo_robots(name, domain, *ROBOTS):
            yield name


@contextmanager
def opened(
    transport: str, domain: int, namespace: str = "", speed: float = 1.0, **settings: str
) -> Iterator[RobotLink]:
    if not namespace:  # a type that is known saves the look for others
        settings = {"command_type": "twist_stamped", **settings}
    made = LinkSettings(domain, namespace, connect_timeout=LIMIT, **settings)  # type: ignore[arg-type]
    link = choice.link(transport, made, RealClock(speed))
    link.open()
    try:
        yield link
    finally:
        link.close()


def answers(link: RobotLink, number: int) -> list[Odometry]:
    """The next odometry messages."""
    taken: list[Odometry] = []
    while len(taken) < number:
        assert link.wait(LIMIT)
        taken += link.take()
    return taken


@pytest.mark.parametrize(
    ("namespace", "wanted", "kind"),
    [
        ("", "auto", TWIST_STAMPED),
        ("other", "auto", TWIST),
        ("/other/", "twist", TWIST),
    ],
)
def test_the_robots_type_of_command_is_found_out(
    transport: str, domain: int, namespace: str, wanted: str, kind: str
) -> None:
    with opened(transport, domain, namespace, command_type=wanted) as link:
        assert link.command_type == kind
        link.send(Command(0.25, 0.5))
        answer = answers(link, 1)[0]

    assert (answer.x, answer.y) == (0.25, 0.5)


def refusal(transport: str, settings: LinkSettings) -> str:
    """The message of a link that does not open, in time."""
    link = choice.link(transport, settings, RealClock())
    began = time.monotonic()
    with pytest.raises(TransportError) as error:
        link.open()
    assert time.monotonic() - began < LIMIT
    link.close()  # is closed already
    return str(error.value)


def test_another_type_of_command_is_refused(transport: str, domain: int) -> None:
    words = refusal(transport, LinkSettings(domain, command_type="twist"))

    assert f"takes {TWIST_STAMPED} at /cmd_vel, not {TWIST}" in words


def test_two_robots_in_one_place_are_refused(
    transport: str, domain: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(discovery, "LEASE", 1.0)
    for wanted in ("auto", "twist"):
        settings = LinkSettings(domain, "twins", command_type=wanted, connect_timeout=1.0)
        words = refusal(transport, settings)

        assert f"2 robots publish /twins/odom in domain {domain}" in words


def test_a_second_link_is_refused_unless_it_only_listens(
    transport: str, domain: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(discovery, "LEASE", 0.5)
    settings = LinkSettings(domain, command_type="twist_stamped", connect_timeout=LIMIT)
    listener = choice.link(transport, settings, RealClock())
    with opened(transport, domain) as link:
        assert "commanded by others at /cmd_vel" in refusal(transport, settings)
        assert list(link.others()) == []  # a link that is refused has not commanded
        listener.open(drives=False)
        assert list(listener.others()) == []
        link.send(Command(0.25, 0.5))
        assert answers(listener, 1)[0].x == 0.25
        with pytest.raises(TransportError, match="listen only"):
            listener.send(Command(0.1, 0.0))
        assert list(link.others()) == []
        listener.close()
        both = choice.link(transport, replace(settings, alone=False), RealClock())
        both.open()  # is not refused
        assert list(both.others()) == []
        assert discovery.until(lambda: bool(link.others()), time.monotonic() + LIMIT)
        both.close()
        listener.open(drives=False)
    with opened(transport, domain) as link:  # who listens is in nobody's way
        assert link.command_type == TWIST_STAMPED
    listener.close()


def test_where_nobody_is_that_is_told(transport: str, domain: int) -> None:
    words = refusal(transport, LinkSettings(domain, "nobody", connect_timeout=1.0))

    assert "within 1 s" in words
    assert f"at /nobody/cmd_vel in domain {domain}" in words
    assert f"/other/cmd_vel ({TWIST})" in words  # what is there instead


def test_commands_and_odometry_arrive_in_order_and_exact(transport: str, domain: int) -> None:
    generator = np.random.default_rng(0)
    values = [*generator.normal(size=(48, 2)).tolist(), [-0.0, 5e-324], [1.8e308, -math.inf]]
    began = time.monotonic()
    with opened(transport, domain) as link:
        taken: list[Odometry] = []
        for first in range(0, 50, 5):  # ten are kept for who is slow
            for linear, angular in values[first : first + 5]:
                link.send(Command(np.float64(linear), angular))
            taken += answers(link, 5)

    assert [[o.x, o.y] for o in taken] == values
    assert [[o.linear, o.angular] for o in taken] == values
    assert math.copysign(1, taken[48].x) == -1
    np.testing.assert_array_equal(np.diff([o.stamp for o in taken]), 1.0)
    received = [began, *(o.received for o in taken), time.monotonic()]
    assert received == sorted(received)
    assert {(o.frame, o.child_frame) for o in taken} == {("odom", "base_footprint")}


def test_a_heading_arrives_within_its_range(transport: str, domain: int) -> None:
    angles = [0.5, -3.0, 3.5, math.pi, -7.0]
    with opened(transport, domain) as link:
        for angle in angles:
            link.send(Command(0.0, angle))
        thetas = [o.theta for o in answers(link, 5)]

    within = [0.5, -3.0, 3.5 - 2 * math.pi, math.pi, -7.0 + 2 * math.pi]
    np.testing.assert_allclose(thetas, within, rtol=0, atol=1e-12)


def test_numbers_that_are_none_pass(transport: str, domain: int) -> None:
    """It is the guard above that decides what they mean."""
    with opened(transport, domain) as link:
        link.send(Command(math.nan, math.nan))
        answer = answers(link, 1)[0]

    assert all(math.isnan(value) for value in answer[2:7])


def test_waiting_ends_at_arrival_or_in_time(transport: str, domain: int) -> None:
    with opened(transport, domain) as link:
        began = time.monotonic()
        assert not link.wait(0.1)
        assert 0.1 <= time.monotonic() - began < LIMIT
        assert not link.wait(0.0)
        assert list(link.take()) == []
        link.send(Command(0.1, 0.0))
        assert link.wait(60.0)
        assert link.wait(60.0)  # it is still there to take
        assert time.monotonic() - began < LIMIT
        assert len(link.take()) == 1


def test_times_are_the_clocks(transport: str, domain: int) -> None:
    clock = RealClock(20.0)
    with opened(transport, domain, speed=20.0) as link:
        real, began = time.monotonic(), clock.now()
        assert not link.wait(2.0)
        assert 0.1 <= time.monotonic() - real < 2.0
        link.send(Command(0.1, 0.0))
        assert began <= answers(link, 1)[0].received <= clock.now()


def test_resets_are_counted(transport: str, domain: int) -> None:
    with opened(transport, domain) as link:
        for _ in range(3):
            link.request_reset()
        resets = 0.0
        while resets < 3:
            resets -= sum(o.x for o in answers(link, 1))
        assert not link.wait(0.15)

    assert resets == 3


def test_a_link_closes_twice_and_opens_again(transport: str, domain: int) -> None:
    with opened(transport, domain) as link:
        link.send(Command(0.1, 0.0))
        link.wait(LIMIT)
        link.close()
        link.close()
        for call in (lambda: link.send(Command(0.1, 0.0)), link.request_reset):
            with pytest.raises(TransportError, match="not open"):
                call()
        with pytest.raises(TransportError, match="not open"):
            print(link.command_type)
        link.open()
        assert not link.wait(0.1)  # nothing old
        link.send(Command(0.3, 0.0))
        assert answers(link, 1)[0].x == 0.3


def test_what_was_sent_before_closing_arrives(transport: str, domain: int) -> None:
    with opened(transport, domain) as link:
        link.send(Command(0.1, 0.0))
        before = answers(link, 1)[0].stamp
        link.send(Command(0.0, 0.0))
    with opened(transport, domain) as link:
        link.send(Command(0.2, 0.0))
        while (after := answers(link, 1)[-1]).x != 0.2:  # the one before may still be answered
            pass

    assert after.stamp == before + 2


def test_namespaces_separate(transport: str, domain: int) -> None:
    with opened(transport, domain) as link, opened(transport, domain, "other") as other:
        other.send(Command(0.1, 0.0))
        assert len(answers(other, 1)) == 1
        assert not link.wait(0.2)


def test_signals_stay_with_whoever_drives(transport: str, domain: int) -> None:
    kinds = (signal.SIGINT, signal.SIGTERM)
    before = [signal.getsignal(kind) for kind in kinds]
    with opened(transport, domain):
        assert [signal.getsignal(kind) for kind in kinds] == before


def test_round_trips_are_timed_at_a_rate(transport: str, domain: int) -> None:
    with opened(transport, domain) as link:
        began = time.perf_counter()
        times = round_trips(link, 6, rate=50.0)
        lasted = time.perf_counter() - began

    assert times.shape == (6,)
    assert (times > 0).all()
    assert 6 / 50 <= lasted < LIMIT
    assert times.sum() < lasted
