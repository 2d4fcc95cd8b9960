"""The transport in memory, in virtual time; and how much waits for whoever takes it."""

from __future__ import annotations

import pytest

from bridges.clock import RealClock, VirtualClock
from bridges.messages import Command, Odometry
from bridges.transports.base import LinkSettings, TransportError
from bridges.transports.memory import MemoryEnd, MemoryLink, Wire, pair
from bridges.transports.receiving import ReceivingEnd, ReceivingLink


class Publisher:
    """A robot that publishes every 0.1 s of virtual time, at x = the last speed it was told."""

    def __init__(self) -> None:
        self.end: MemoryEnd | None = None
        self.speed = 0.0

    def tick(self, moment: float) -> None:
        assert self.end is not None
        for command in self.end.take_commands():
            self.speed = command.linear
        if round(moment * 100) % 10 == 0:
            self.end.publish(Odometry(moment, -1.0, self.speed, 0.0, 0.0, 0.0, 0.0), (0, 0, 0))


def test_virtual_time_passes_while_the_link_waits() -> None:
    robot = Publisher()
    clock = VirtualClock(0.01, robot.tick)
    link, end = pair(clock)
    robot.end = end
    end.open()
    link.open()
    link.send(Command(0.2, 0.0))

    assert not link.wait(0.05)
    assert clock.now() == pytest.approx(0.05)
    assert link.wait(3600.0)  # of virtual time
    assert clock.now() == pytest.approx(0.1)
    clock.sleep_until(0.35)

    taken = link.take()
    assert [o.stamp for o in taken] == pytest.approx([0.1, 0.2, 0.3])
    assert [o.received for o in taken] == [o.stamp for o in taken]
    assert [o.x for o in taken] == [0.2] * 3
    assert not link.wait(0.0)
    assert clock.now() == pytest.approx(0.35)


def test_pairs_do_not_meet() -> None:
    clock = RealClock()
    (first, end), (second, other) = pair(clock), pair(clock)
    for side in (end, other, first, second):
        side.open()
    first.send(Command(0.1, 0.0))

    assert list(end.take_commands()) == [Command(0.1, 0.0)]
    assert list(other.take_commands()) == []


def test_another_link_of_the_process_is_seen() -> None:
    wire, settings, clock = Wire(), LinkSettings(connect_timeout=0.05), RealClock()
    MemoryEnd(settings, clock, wire).open()
    elsewhere = LinkSettings(namespace="elsewhere")
    link, other = (MemoryLink(each, clock, wire) for each in (settings, elsewhere))
    wire.links += [link, other]
    assert list(link.others()) == []
    wire.links.append(MemoryLink(settings, clock, wire))
    assert list(link.others()) == ["another link of this process"]


def test_a_closed_end_is_nobody() -> None:
    link, end = pair(RealClock(), LinkSettings(connect_timeout=0.05, command_type="twist"))
    end.open()
    link.open()
    end.close()
    end.close()
    link.send(Command(0.1, 0.0))  # as to a robot that has died: nobody tells

    with pytest.raises(TransportError, match="nobody listens"):
        link.request_reset()
    with pytest.raises(TransportError, match="end is not open"):
        end.publish(Odometry(0, 0, 0, 0, 0, 0, 0), (0, 0, 0))
    link.close()
    with pytest.raises(TransportError, match="no robot was found"):
        link.open()


def test_the_newest_thousand_are_kept() -> None:
    link, end = ReceivingLink(RealClock()), ReceivingEnd(RealClock())
    for i in range(1003):
        link.put(Odometry(float(i), 0, 0, 0, 0, 0, 0))
        end.put(Command(float(i), 0))

    assert [o.stamp for o in link.take()] == [float(i) for i in range(3, 1003)]
    assert [c.linear for c in end.take_commands()] == [float(i) for i in range(3, 1003)]


def test_an_end_wakes_for_commands_and_resets() -> None:
    end = ReceivingEnd(RealClock())
    assert not end.wait(0.02)
    end.put_reset()
    assert end.wait(60.0)
    assert (end.take_resets(), end.take_resets()) == (1, 0)
    end.put(Command(0.1, 0.0))
    assert end.wait(60.0)
    assert (end.take_resets(), len(end.take_commands())) == (0, 1)
