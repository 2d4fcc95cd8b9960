"""Where a robot is looked for: its domain and the names of its topics."""

from __future__ import annotations

import os
import re

from bridges.messages import TWIST, TWIST_STAMPED
from bridges.transports.base import LinkSettings, TransportError

# topics, under the namespace
ODOMETRY, COMMANDS, RESET = "odom", "cmd_vel", "reset"
TYPES = {"twist": TWIST, "twist_stamped": TWIST_STAMPED}  # of the setting command_type

_NAMESPACE = re.compile(r"[A-Za-z_]\w*(/[A-Za-z_]\w*)*", re.ASCII)
_HIGHEST_DOMAIN = 232  # above it, ports run out


def domain_id(settings: LinkSettings) -> int:
    """The domain: the setting, else ROS_DOMAIN_ID, else 0.

    Raises:
        TransportError: ROS_DOMAIN_ID is no domain.
    """
    if settings.domain_id is not None:
        return settings.domain_id
    text = os.environ.get("ROS_DOMAIN_ID", "").strip() or "0"
    if not text.isdecimal() or int(text) > _HIGHEST_DOMAIN:
        raise TransportError(
            f"ROS_DOMAIN_ID={text} is no domain: it must be a whole number, at most"
            f" {_HIGHEST_DOMAIN} (or give link.domain_id)"
        )
    return int(text)


def topic(settings: LinkSettings, name: str) -> str:
    """A topic's full name, `/cmd_vel` or `/<namespace>/cmd_vel`.

    Raises:
        TransportError: the namespace is not a name in ROS.
    """
    namespace = settings.namespace.strip("/")
    if namespace and not _NAMESPACE.fullmatch(namespace):
        raise TransportError(
            f"namespace={settings.namespace} is not allowed: it must be letters, digits and _,"
            " none of its parts beginning with a digit, such as robot1 or lab/robot1"
        )
    return f"/{namespace}/{name}" if namespace else f"/{name}"


def end_type(settings: LinkSettings) -> str:
    """What a simulated robot takes as commands."""
    return TYPES.get(settings.command_type, TWIST_STAMPED)
