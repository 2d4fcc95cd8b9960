"""What settings and a bundle make of the rules by which a robot is driven."""

from __future__ import annotations

import pytest

from bridges.run_settings import RunConfig
from bridges.settings import SettingError, parse
from bridges.tracking import Room
from bridges.world import rules_of
from tests.bridges import robot_bundles


def test_a_room_is_where_the_robot_may_be() -> None:
    bundle = robot_bundles.constant((0.0, 0.0))  # its goal is at (2, 0)
    config = parse(["room=[-0.5,2.5,-1,1.5]"], RunConfig())
    room = rules_of(config, bundle).guard.room
    assert room.holds(2.0, 0.0)
    assert [room.holds(*place) for place in ((-0.6, 0), (2.6, 0), (0, -1.1), (0, 1.6))] == [
        False
    ] * 4
    everywhere = rules_of(RunConfig(), bundle).guard.room
    assert everywhere == Room()
    assert everywhere.holds(-9.0, 9.0)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[-1,1]", "it must be"),
        ("[2.5,-1,-1,1]", "it must be"),
        ("[-1,1.9,-1,1]", "leaves out the goal, which is at"),
    ],
)
def test_a_room_that_is_none_is_refused(text: str, words: str) -> None:
    config = parse([f"room={text}"], RunConfig())
    with pytest.raises(SettingError, match=words):
        rules_of(config, robot_bundles.constant((0.0, 0.0)))
