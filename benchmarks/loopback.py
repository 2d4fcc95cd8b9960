"""Keeps the messages of a benchmark on this machine."""

from __future__ import annotations

import os

_LOOPBACK = {
    "CYCLONEDDS_URI": "<CycloneDDS><Domain><General><Interfaces>"
    '<NetworkInterface name="lo" multicast="false"/>'
    "</Interfaces><AllowMulticast>false</AllowMulticast></General></Domain></CycloneDDS>",
    "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
}


def stay_here() -> None:
    """Nothing leaves this machine, unless the user's environment says otherwise."""
    for name, value in _LOOPBACK.items():
        os.environ.setdefault(name, value)
