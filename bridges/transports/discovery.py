"""Finding the robot and its type of command, and saying well what is wrong when there is none."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence, Set
from typing import NamedTuple

from bridges.messages import COMMAND_TYPES
from bridges.transports.base import LinkSettings, TransportError
from bridges.transports.names import COMMANDS, ODOMETRY, TYPES, topic

# s between looks, and how long all of a robot's endpoints may need to show after the first ones
_PAUSE, SETTLE = 0.02, 0.3
# real s that who was killed goes on being seen: 20 with Fast DDS, 10 with CycloneDDS, and a margin
LEASE = 22.0
_AFTER = 1.0  # s in which a robot must be found when who was killed is gone
_SHOWN = 20  # topics that a message lists
_NOT_SHOWN = ("/rosout", "/parameter_events")


class Seen(NamedTuple):
    """What discovery shows at a moment."""

    command_types: Set[str]  # that somebody takes at our command topic, ROS names
    odometry: int  # how many publish it at our topic
    topics: Mapping[str, str]  # all that others have: name, types
    drivers: Sequence[str] = ()  # others who publish at our command topic, in words


def until(true: Callable[[], bool], deadline: float) -> bool:
    """Waits, to a moment of time.monotonic at most, for something to become true."""
    while not true():
        if time.monotonic() >= deadline:
            return False
        time.sleep(_PAUSE)
    return True


def find_robot(
    look: Callable[[], Seen],
    settings: LinkSettings,
    place: str,
    settle: float = SETTLE,
    lease: float | None = None,
) -> str:
    """Waits for a robot and finds out its type of command.

    Args:
        look: what discovery shows now.
        settings: the topics' namespace, the wanted type of command, how long to wait.
        place: where we look, in words.
        settle: s that go on being watched after the robot was seen.
        lease: s that who was killed may be seen; None: LEASE.

    Returns:
        one of COMMAND_TYPES.

    Raises:
        TransportError: no robot is there in time, it takes another type of command than the
            settings', it is not clear which, there are several robots, or others command it.
    """
    lease = LEASE if lease is None else lease
    deadline = time.monotonic() + settings.connect_timeout
    found = gone = math.inf  # when the robot is known, and when who was killed is not seen any more
    while True:
        seen, now = look(), time.monotonic()
        if crowd := _crowd(seen, settings, place):
            if gone == math.inf:
                gone = now + lease
                _tell_of_waiting(crowd, lease)
            if now >= gone:
                raise TransportError(f"{crowd.who}{crowd.cure}")
            found, deadline = math.inf, max(deadline, now + settle + _AFTER)
        elif seen.command_types and seen.odometry:
            found = min(found, now)
        if now - found >= settle or now >= deadline:
            break
        time.sleep(_PAUSE)
    wanted = TYPES.get(settings.command_type)
    if not seen.command_types or (not seen.odometry and wanted in (None, *seen.command_types)):
        raise TransportError(_nobody(seen, settings, place))
    return _chosen(seen.command_types, settings)


class _Crowd(NamedTuple):
    """What must not be there beside one robot and us."""

    who: str
    cure: str


def _crowd(seen: Seen, settings: LinkSettings, place: str) -> _Crowd | None:
    if seen.odometry > 1:
        return _Crowd(
            f"{seen.odometry} robots publish {topic(settings, ODOMETRY)} in {place}",
            ": all would be driven, and their odometry mixed. Give each a namespace"
            " (link.namespace) or a domain (link.domain_id) of its own",
        )
    if seen.drivers and seen.command_types and seen.odometry:
        commands = topic(settings, COMMANDS)
        return _Crowd(
            f"the robot is commanded by others at {commands} in {place}: {', '.join(seen.drivers)}",
            ". It would obey them and us, and what came of it would be learned from. End them: a"
            f" second bridge, remote control, navigation (ros2 topic info -v {commands} names"
            " nodes). What mixes or passes commands on, as twist_mux and the node deadman do, is"
            " commanded at its own input: the ROS package has commands:=TOPIC for that. With"
            " link.alone=false others may command it, too",
        )
    return None


def _tell_of_waiting(crowd: _Crowd, lease: float) -> None:
    if lease > 0:
        print(
            f"{crowd.who}. Who was killed is seen for some time more: waiting for up to"
            f" {lease:.0f} s",
            flush=True,
        )


def _chosen(types: Set[str], settings: LinkSettings) -> str:
    wanted, name = TYPES.get(settings.command_type), topic(settings, COMMANDS)
    listed = " and ".join(sorted(types))
    if wanted is not None:
        if wanted in types:
            return wanted
        raise TransportError(
            f"the robot takes {listed} at {name}, not {wanted} as"
            f" command_type={settings.command_type} says; DDS would drop every command silently."
            " Leave command_type at auto to send what the robot takes"
        )
    known = sorted(types & set(COMMAND_TYPES))
    if len(known) == 1:
        return known[0]
    if known:
        raise TransportError(
            f"both {listed} are taken at {name}, so it is not clear which the robot takes (the"
            " other may be somebody who watches): give command_type=twist (ROS 2 Humble) or"
            " command_type=twist_stamped (Jazzy and later)"
        )
    raise TransportError(f"{listed} is taken at {name}; this bridge sends {_either()}")


def _either() -> str:
    return " or ".join(COMMAND_TYPES)


def _nobody(seen: Seen, settings: LinkSettings, place: str) -> str:
    if seen.command_types:
        missing = f"nobody publishes nav_msgs/msg/Odometry at {topic(settings, ODOMETRY)}"
    else:
        missing = f"nobody takes {_either()} at {topic(settings, COMMANDS)}"
    lines = [f"no robot was found within {settings.connect_timeout:g} s: {missing} in {place}."]
    shown = [f"{name} ({kind})" for name, kind in sorted(seen.topics.items())]
    shown = [text for text in shown if not text.startswith(_NOT_SHOWN)]
    if shown:
        more = f" and {len(shown) - _SHOWN} more" if len(shown) > _SHOWN else ""
        lines.append(f"Topics that are there: {', '.join(shown[:_SHOWN])}{more}.")
        lines.append("Is the robot's software running, and link.namespace right?")
    else:
        lines.append(
            "No topic of anybody was seen there. Is the robot on, and its ROS_DOMAIN_ID the same?"
            " Where multicast does not work, as on much Wi-Fi, give link.peers=[ADDRESS]; a robot"
            " with CycloneDDS then needs <ParticipantIndex>auto</ParticipantIndex> in its own"
            " CYCLONEDDS_URI."
        )
    lines.append("(A simulated robot to try with: python -m bridges.sim_turtlebot.)")
    return " ".join(lines)


def nobody_resets(name: str) -> str:
    """What is wrong where nobody takes a request to go back to the start, in words."""
    return (
        f"nobody listens at {name}: only simulated robots can be reset, and if this one was reset "
        "before, it is gone by now (was its process ended?)"
    )
