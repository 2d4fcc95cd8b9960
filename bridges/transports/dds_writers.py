"""Who else writes a topic, as discovery tells while time goes on."""

from __future__ import annotations

from typing import Any, NamedTuple

from cyclonedds.builtin import (
    BuiltinDataReader,
    BuiltinTopicDcpsParticipant,
    BuiltinTopicDcpsPublication,
)
from cyclonedds.core import InstanceState, Policy, ReadCondition, SampleState, ViewState
from cyclonedds.domain import DomainParticipant

from bridges.transports.dds_types import ros_type

_MANY = 100  # samples read at once; what is left wakes the thread again
# what CycloneDDS tells of its processes (rmw_cyclonedds, too)
_PROCESS, _NUMBER, _HOST = "__ProcessName", "__Pid", "__Hostname"


class _Writer(NamedTuple):
    participant: str  # its key
    kind: str  # of its messages


class Writers:
    """The writers of a topic that are not of the participant's own, of whatever type.

    `update` is for the thread that reads, `words` for any.

    Args:
        participant: that looks.
        topic: DDS's name of it.
    """

    def __init__(self, participant: DomainParticipant, topic: str) -> None:
        self._topic, self._ours = topic, participant.guid
        self._participants = BuiltinDataReader(participant, BuiltinTopicDcpsParticipant)
        self._publications = BuiltinDataReader(participant, BuiltinTopicDcpsPublication)
        self._processes: dict[str, str] = {}  # by participant
        self._writers: dict[str, _Writer] = {}

    def conditions(self) -> list[ReadCondition]:
        """True when there is something to `update`."""
        new = SampleState.NotRead | ViewState.Any | InstanceState.Any
        return [ReadCondition(reader, new) for reader in (self._participants, self._publications)]

    def update(self) -> None:
        """Takes what discovery tells."""
        for each in self._participants.take(_MANY):
            if _is_there(each):
                self._processes[str(each.key)] = _process(each.qos)
            else:
                self._processes.pop(str(each.key), None)
        for each in self._publications.take(_MANY):
            if not _is_there(each):
                self._writers.pop(str(each.key), None)
            elif each.topic_name == self._topic and each.participant_key != self._ours:
                writer = _Writer(str(each.participant_key), ros_type(each.type_name))
                self._writers[str(each.key)] = writer

    def words(self) -> list[str]:
        """Each writer that is there now."""
        return sorted(
            f"{self._processes.get(writer.participant) or 'a program'} ({writer.kind})"
            for writer in tuple(self._writers.values())
        )


def _is_there(sample: Any) -> bool:
    return bool(sample.sample_info.instance_state == InstanceState.Alive)


def _process(qos: Any) -> str:
    """What a participant tells of its process; nothing, as a rule, if it is not CycloneDDS's."""
    told = {policy.key: policy.value for policy in qos if isinstance(policy, Policy.Property)}
    if _PROCESS not in told:
        return ""
    number = f" (process {told[_NUMBER]})" if _NUMBER in told else ""
    return f"{told[_PROCESS]}{number}{' on ' + told[_HOST] if _HOST in told else ''}"
