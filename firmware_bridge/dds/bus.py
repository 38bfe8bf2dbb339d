"""A DDS participant on one interface, with the queues this project uses."""

from __future__ import annotations

import contextlib
import struct
import threading
from collections.abc import Iterator
from typing import Any, Final

from cyclonedds.core import DDSException, InstanceState, ReadCondition, SampleState, ViewState, WaitSet
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy, Qos
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic

from firmware_bridge.core.config import DdsConfig
from firmware_bridge.core.robot_state import DdsError
from firmware_bridge.dds.binding import take_undecoded

# Everything a hostile or foreign sample can make the pure-Python CDR decoder raise.
DECODE_ERRORS: Final = (struct.error, ValueError, IndexError, KeyError, TypeError, AttributeError, OverflowError)
MAX_SAMPLE_BYTES: Final = 10 * 1024 * 1024  # more than a camera frame
# What a call into DDS itself can raise.
DDS_ERRORS: Final = (DDSException,)
_FRESH: Final = ViewState.Any | InstanceState.Alive | SampleState.NotRead


def domain_xml(config: DdsConfig, max_sample_bytes: int = MAX_SAMPLE_BYTES) -> str:
    """Cyclone DDS configuration that also finds 0.10.2 peers, with and without multicast (protocol facts, section 1).

    `ParticipantIndex auto` up to 9 is 0.10.2's own port range: at most ten participants a host, unless the robot file
    has `dds.participants`. Tracing stays off, so nothing is written to a fixed path in /tmp. Discovery fills a receive
    buffer from end to end, a few hundred bytes a second, before the next takes its place: Cyclone's own 1 MiB looks
    like a leak for half an hour, 96 KiB are full within minutes. A chunk is one packet: more than UDP has.
    """
    peers = "".join(f'<Peer address="{peer}"/>' for peer in config.peers)
    return (
        '<CycloneDDS><Domain Id="any"><General><Interfaces>'
        f'<NetworkInterface name="{config.interface}" priority="default" multicast="default"/>'
        "</Interfaces></General><Discovery><ParticipantIndex>auto</ParticipantIndex>"
        f"<MaxAutoParticipantIndex>{config.participants - 1}</MaxAutoParticipantIndex><Peers>{peers}</Peers>"
        "</Discovery><Sizing><ReceiveBufferSize>96 KiB</ReceiveBufferSize>"
        "<ReceiveBufferChunkSize>66 KiB</ReceiveBufferChunkSize></Sizing>"
        f"<Internal><MaxSampleSize>{max_sample_bytes} B</MaxSampleSize></Internal></Domain></CycloneDDS>"
    )


class Bus:
    """One participant in one domain; a process can open each domain once. Raises DdsError."""

    def __init__(self, config: DdsConfig, *, max_sample_bytes: int = MAX_SAMPLE_BYTES) -> None:
        """`max_sample_bytes`: what is larger is dropped before it takes memory."""
        try:
            # Without a reference to it Cyclone forgets the configuration before the participant reads it.
            self._domain = Domain(config.domain, domain_xml(config, max_sample_bytes))
            self.participant = DomainParticipant(config.domain)
        except DDSException as error:
            where = f"DDS: cannot join domain {config.domain} on interface {config.interface!r}"
            if error.code == DDSException.DDS_RETCODE_PRECONDITION_NOT_MET:
                raise DdsError(f"{where}: this process has already opened it; close that Bus or share it") from error
            raise DdsError(
                f"{where} ({error.msg}); check the interface's name with `ip link` and that at most"
                f" {config.participants} programs on this machine use the domain (dds.participants)"
            ) from error
        self._topics: dict[str, Topic[Any]] = {}
        self._topics_lock = threading.Lock()  # a camera's thread may come for the same topic as another

    def reader(
        self, name: str, kind: Any, *, depth: int = 1, reliable: bool = False, foreign: bool = False
    ) -> DataReader[Any]:
        """Reader of the newest `depth` samples; best effort matches every writer. `foreign`: not those of this Bus.

        A `reliable` one matches reliable writers only.
        """
        reliability = Policy.Reliability.Reliable(0) if reliable else Policy.Reliability.BestEffort
        local = Policy.IgnoreLocal.Participant if foreign else Policy.IgnoreLocal.Nothing
        qos = Qos(reliability, Policy.History.KeepLast(depth), local)
        return DataReader(self.participant, self._topic(name, kind), qos)

    def writer(self, name: str, kind: Any, *, depth: int = 1, reliable: bool = True) -> DataWriter[Any]:
        """Writer that never waits for a slow reader: the newest `depth` samples replace older ones.

        A `reliable` one matches every reader, the other only those that are best effort.
        """
        reliability = Policy.Reliability.Reliable(0) if reliable else Policy.Reliability.BestEffort
        qos = Qos(reliability, Policy.History.KeepLast(depth))
        return DataWriter(self.participant, self._topic(name, kind), qos)

    def waitset(self, *readers: DataReader[Any]) -> WaitSet:
        """Wait set that wakes up when one of `readers` has something unread."""
        waitset = WaitSet(self.participant)
        for reader in readers:
            waitset.attach(ReadCondition(reader, _FRESH))
        return waitset

    def close(self) -> None:
        """Leave the bus now and let this process open the domain again; nothing made by this object works after."""
        # The binding deletes an entity when Python forgets it, which is too late for the next Bus of this process.
        # Deleting the domain deletes everything in it; the objects' own attempts later find nothing.
        self._domain._delete(self._domain._ref)

    def _topic(self, name: str, kind: Any) -> Topic[Any]:
        with self._topics_lock:
            if name not in self._topics:
                self._topics[name] = Topic(self.participant, name, kind)
            return self._topics[name]


def take_bytes(reader: DataReader[Any], limit: int = 64) -> Iterator[tuple[bytes, Any]]:
    """Take up to `limit` waiting samples one by one without decoding them: (CDR bytes with header, sample info).

    Notices without data (a writer has left) are passed over.
    """
    for _ in range(limit):
        taken = take_undecoded(reader)  # what DataReader.take does, which decodes whatever the size
        if isinstance(taken, int):
            raise DDSException(taken, "Occurred while taking data")
        if not taken:
            return
        ((data, info),) = taken
        if info.valid_data:
            yield data, info


def take_each(reader: DataReader[Any], limit: int = 64, max_bytes: int = MAX_SAMPLE_BYTES) -> Iterator[Any]:
    """Take up to `limit` waiting samples one by one; a sample that does not decode is None, for the caller to count.

    So is one of more than `max_bytes` as it came over the network: it is not decoded, which takes 50 ms a megabyte.
    """
    kind = reader.topic.data_type
    for data, info in take_bytes(reader, limit):
        sample = None
        if len(data) <= max_bytes:
            with contextlib.suppress(Exception):  # the decoder of a hostile sample may raise anything
                sample = kind.deserialize(data)
                sample.sample_info = info
        yield sample if isinstance(sample, kind) else None
