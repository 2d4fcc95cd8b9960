"""A process's part in a DDS domain: which network it uses, and whom it looks for where."""

from __future__ import annotations

import ipaddress
import os
import socket
from weakref import WeakValueDictionary
from xml.sax.saxutils import quoteattr

from cyclonedds.core import DDSException
from cyclonedds.domain import Domain, DomainParticipant

from bridges.transports.base import LinkSettings, TransportError
from bridges.transports.names import domain_id

# CycloneDDS takes a domain's configuration once in a process, so ends that say the same share it.
_DOMAINS: WeakValueDictionary[tuple[int, str], Domain] = WeakValueDictionary()


def join(settings: LinkSettings) -> tuple[Domain | None, DomainParticipant]:
    """Joins the domain.

    Returns:
        what must be kept as long as the participant, and the participant.

    Raises:
        TransportError: a peer's name is unknown, or CycloneDDS refuses the network.
    """
    number, text = domain_id(settings), configuration(settings)
    domain = None
    try:
        if text is not None:
            domain = _DOMAINS.get((number, text)) or Domain(number, text)
            _DOMAINS[number, text] = domain
        return domain, DomainParticipant(number)
    except (DDSException, UnicodeEncodeError) as error:
        domain = None  # ends here, not with the error's traceback
        raise TransportError(_refused(settings, number, error)) from error


def place(settings: LinkSettings) -> str:
    """Where the robot is looked for, in words."""
    words = [f"domain {domain_id(settings)}"]
    if settings.peers:
        words.append(f"at {', '.join(settings.peers)}")
    if settings.interface:
        words.append(f"through {settings.interface}")
    if os.environ.get("CYCLONEDDS_URI"):
        words.append("as CYCLONEDDS_URI says")
    return " ".join(words)


def configuration(settings: LinkSettings) -> str | None:
    """CycloneDDS's configuration; None if the settings say nothing and its own way is right.

    CYCLONEDDS_URI keeps counting: CycloneDDS reads a list of files and texts, ours comes last.
    Peers and interfaces add up; of a value that both give, ours counts.

    Raises:
        TransportError: a peer's name is unknown.
    """
    if not (settings.peers or settings.interface):
        return None
    interface = peers = ""
    if settings.interface:
        kind = "address" if _is_address(settings.interface) else "name"
        interface = (
            "<General><Interfaces>"
            f"<NetworkInterface {kind}={quoteattr(settings.interface)}/>"
            "</Interfaces></General>"
        )
    if settings.peers:
        # An index makes this process's ports the well-known ones, so that a peer finds it, too.
        listed = "".join(f"<Peer Address={quoteattr(_address(peer))}/>" for peer in settings.peers)
        peers = (
            "<Discovery><ParticipantIndex>auto</ParticipantIndex>"
            f"<Peers>{listed}</Peers></Discovery>"
        )
    ours = f"<CycloneDDS><Domain>{interface}{peers}</Domain></CycloneDDS>"
    return ",".join(filter(None, (os.environ.get("CYCLONEDDS_URI"), ours)))


def _is_address(text: str) -> bool:
    try:
        ipaddress.ip_address(text)
    except ValueError:
        return False
    return True


def _address(peer: str) -> str:
    """A peer as a number: CycloneDDS ends the process over a name that nobody knows."""
    host, colon, port = peer.partition(":")
    try:
        found = socket.getaddrinfo(host, port or None, socket.AF_INET, socket.SOCK_DGRAM)
    except (OSError, UnicodeError) as error:
        raise TransportError(
            f"the peer {peer} has no address ({error}): give a name that this machine knows, or"
            " the robot's IPv4 address, such as link.peers=[192.168.0.7]"
        ) from error
    return f"{found[0][4][0]}{colon}{port}"


def _refused(settings: LinkSettings, number: int, error: Exception) -> str:
    says = "CYCLONEDDS_URI" if os.environ.get("CYCLONEDDS_URI") else ""
    asked = [
        f"{name}={value}"
        for name, value in (("interface", settings.interface), ("peers", settings.peers))
        if value
    ]
    what = ", ".join(filter(None, (*asked, says))) or "the system's network"
    hint = (
        " This process is in that domain already, with other peers or another interface; it must"
        " be the same for all of a process."
        if getattr(error, "code", None) == DDSException.DDS_RETCODE_PRECONDITION_NOT_MET
        else " CycloneDDS may have said more above (an interface that CYCLONEDDS_URI names must"
        " not be given again)."
    )
    return f"CycloneDDS does not join domain {number} with {what}: {error}{hint}"
