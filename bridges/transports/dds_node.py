"""A participant of a DDS domain: its readers, its writers, and what it sees of others."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from typing import Any

from cyclonedds.builtin import (
    BuiltinDataReader,
    BuiltinTopicDcpsPublication,
    BuiltinTopicDcpsSubscription,
)
from cyclonedds.core import (
    DDSException,
    GuardCondition,
    InstanceState,
    Policy,
    Qos,
    ReadCondition,
    SampleState,
    ViewState,
    WaitSet,
)
from cyclonedds.internal import InvalidSample
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

from bridges.transports import names
from bridges.transports.base import LinkSettings, TransportError
from bridges.transports.dds_network import join
from bridges.transports.dds_types import HASHES, ODOMETRY, TYPES, ros_type
from bridges.transports.dds_writers import Writers
from bridges.transports.discovery import Seen

_MANY = 10_000  # samples or endpoints read at once: all of them


class Node:
    """A participant of a domain with its readers and writers, and a thread that reads.

    Args:
        settings: which domain, and the topics' namespace.
        fail: told what ends the thread before it is closed.
    """

    def __init__(self, settings: LinkSettings, fail: Callable[[Exception], None]) -> None:
        self._settings, self._fail = settings, fail
        self._domain, participant = join(settings)
        self._participant = participant
        self._publications = BuiltinDataReader(participant, BuiltinTopicDcpsPublication)
        self._subscriptions = BuiltinDataReader(participant, BuiltinTopicDcpsSubscription)
        self._waitset = WaitSet(participant)
        self._closing = GuardCondition(participant)
        self._waitset.attach(self._closing)
        self._writers: Writers | None = None
        self._routes: list[tuple[DataReader, Callable[[Any], None]]] = []
        self._thread = threading.Thread(target=self._receive, name="dds", daemon=True)

    def reader(self, name: str, kind: str, deliver: Callable[[Any], None]) -> DataReader:
        """Reads a topic, once started: each sample is delivered, on another thread."""
        reader = DataReader(self._participant, self._topic(name, kind), _qos(kind))
        new = ReadCondition(reader, SampleState.NotRead | ViewState.Any | InstanceState.Any)
        self._waitset.attach(new)
        self._routes.append((reader, deliver))
        return reader

    def writer(self, name: str, kind: str) -> DataWriter:
        """Writes a topic."""
        return DataWriter(self._participant, self._topic(name, kind), _qos(kind))

    def watch(self, name: str) -> None:
        """Follows, once started, who else writes a topic."""
        self._writers = Writers(self._participant, f"rt{names.topic(self._settings, name)}")
        for new in self._writers.conditions():
            self._waitset.attach(new)

    def others(self) -> Sequence[str]:
        """Who else writes the topic that is watched, in words."""
        return self._writers.words() if self._writers is not None else ()

    def start(self) -> None:
        """Begins to read."""
        self._thread.start()

    def look(self) -> Seen:
        """What discovery shows of others."""
        ours = self._participant.guid
        found = [
            (kind, endpoint)
            for kind, reader in (("pub", self._publications), ("sub", self._subscriptions))
            for endpoint in reader.read(_MANY)
            if endpoint.sample_info.instance_state == InstanceState.Alive
            and endpoint.participant_key != ours
            and endpoint.topic_name.startswith("rt/")
        ]
        ends = {(kind, e.topic_name[2:], ros_type(e.type_name), str(e.key)) for kind, e in found}
        types = {end[:3] for end in ends}
        commands = names.topic(self._settings, names.COMMANDS)
        odometry = names.topic(self._settings, names.ODOMETRY)
        topics: dict[str, set[str]] = {}
        for _, name, kind in types:
            topics.setdefault(name, set()).add(kind)
        return Seen(
            {t for kind, name, t in types if (kind, name) == ("sub", commands)},
            sum(end[:3] == ("pub", odometry, ODOMETRY) for end in ends),
            {name: ", ".join(sorted(each)) for name, each in topics.items()},
            self.others(),
        )

    def close(self) -> None:
        """Leaves the domain."""
        self._closing.set(True)
        if self._thread.is_alive():
            self._thread.join()
        # CycloneDDS's objects end when nobody has them any more: what uses others first
        del self._waitset, self._closing, self._publications, self._subscriptions
        self._writers = None
        self._routes.clear()
        # and the participant with all that is left, such as what an error's traceback still has
        self._participant.__del__()
        del self._participant, self._domain

    def _topic(self, name: str, kind: str) -> Topic:
        return Topic(self._participant, f"rt{names.topic(self._settings, name)}", TYPES[kind])

    def _receive(self) -> None:
        try:
            while True:
                self._waitset.wait(duration(infinite=True))
                if self._closing.read():
                    return
                self._deliver()
        except Exception as error:  # in a thread nobody would see it
            self._fail(error)

    def _deliver(self) -> None:
        if self._writers is not None:
            self._writers.update()
        for reader, deliver in self._routes:
            for sample in reader.take(_MANY):
                if not isinstance(sample, InvalidSample):  # one that says a writer has gone
                    deliver(sample)


def _qos(kind: str) -> Qos:
    return Qos(
        Policy.Reliability.Reliable(max_blocking_time=duration(milliseconds=100)),
        Policy.Durability.Volatile,
        Policy.History.KeepLast(10),
        Policy.DataRepresentation(use_cdrv0_representation=True),
        Policy.Userdata(f"typehash={HASHES[kind]};".encode()),
    )


def write(writer: DataWriter, message: Any) -> None:
    """Sends a message.

    Raises:
        TransportError: CycloneDDS refuses it.
    """
    try:
        writer.write(message)
    except DDSException as error:
        raise TransportError(f"a message could not be sent: {error}") from error
