"""MAVLink packets of the bridge: found on every kind of link, and rejected when anything about them is wrong."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as dialect

from firmware_bridge.core.sections import ConfigError
from firmware_bridge.mavlink.signing import Signatures, read_key
from firmware_bridge.mavlink.wire import Reader, Writer

ATTITUDE = 30
KEY = bytes(range(32))
START_TICKS = 10**12
S = 1_000_000_000


def attitude(stamp_ms: int = 0) -> object:
    return dialect.MAVLink_attitude_message(stamp_ms, 0.1, 0.2, 0.3, 0.0, 0.0, 0.5)


def signatures(start_ticks: int = START_TICKS) -> Signatures:
    return Signatures(KEY, start_ticks, 0)


def signed(ticks: int = START_TICKS, key: bytes = KEY, link: int = 0) -> bytes:
    """A signed packet of the autopilot with this timestamp."""
    packer = dialect.MAVLink(None, srcSystem=1, srcComponent=1)
    packer.signing.secret_key, packer.signing.sign_outgoing = key, True
    packer.signing.timestamp, packer.signing.link_id = ticks, link
    return bytes(attitude().pack(packer))


NOISE = st.binary(max_size=40).filter(lambda data: not {0xFD, 0xFE} & set(data))


class TestStream:
    @pytest.mark.slow
    @given(
        noise=st.lists(NOISE, min_size=4, max_size=4),
        cuts=st.lists(st.integers(1, 30), min_size=1),
    )
    @settings(max_examples=60, deadline=None)
    def test_packets_between_noise_and_in_pieces_are_all_found(self, noise: list[bytes], cuts: list[int]) -> None:
        writer, reader = Writer(1, 1), Reader((ATTITUDE,), stream=True)
        data = b"".join(bytes(each) + writer.pack(attitude(n), 0) for n, each in enumerate(noise))
        found, at, turn = [], 0, 0
        while at < len(data):
            size = cuts[turn % len(cuts)]
            found += reader.read(data[at : at + size], 0)
            at, turn = at + size, turn + 1
        assert [message.time_boot_ms for message in found] == [0, 1, 2, 3]

    def test_after_a_false_start_the_next_packet_is_found(self) -> None:
        reader, writer = Reader((ATTITUDE,), stream=True), Writer(1, 1)
        false = b"\xfd\x28\x00\x00\x00\x01\x01\x1e\x00\x00"  # claims 40 bytes that belong to other packets
        found = reader.read(false + b"".join(writer.pack(attitude(n), 0) for n in range(4)), 0)
        assert [message.time_boot_ms for message in found] == [0, 1, 2, 3] and reader.counts.broken >= 1

    def test_a_lost_byte_costs_one_packet(self) -> None:
        reader, writer = Reader((ATTITUDE,), stream=True), Writer(1, 1)
        packets = [writer.pack(attitude(n), 0) for n in range(5)]
        found = reader.read(packets[0] + packets[1][:10] + packets[1][11:] + b"".join(packets[2:]), 0)
        assert [message.time_boot_ms for message in found] == [0, 2, 3, 4]

    @given(data=st.binary(max_size=3000))
    @settings(max_examples=100, deadline=None)
    def test_no_bytes_are_kept_without_bound(self, data: bytes) -> None:
        reader = Reader((ATTITUDE,), stream=True)
        for _ in range(8):
            reader.read(data, 0)
        assert len(reader._buffer) <= 8192


@pytest.mark.parametrize("is_signed", [False, True])
@pytest.mark.parametrize("stream", [False, True])
def test_a_step_examines_a_bounded_number_of_unwanted_or_unsigned_packets(
    monkeypatch: pytest.MonkeyPatch, is_signed: bool, stream: bool
) -> None:
    examined: list[bytes] = []
    check = Reader._is_whole
    monkeypatch.setattr(Reader, "_is_whole", lambda *given: examined.append(given[1]) or check(*given))
    reader, writer = Reader((ATTITUDE,), signatures() if is_signed else None, stream=stream), Writer(1, 1)
    unwanted = writer.pack(dialect.MAVLink_heartbeat_message(10, 12, 0, 0, 4, 3), 0)
    for _ in range(64):
        assert reader.read(unwanted * 10, 0) == []
    assert len(examined) == 256
    reader.begin_step()
    for _ in range(64):
        reader.read(unwanted * 10, 0)
    assert 500 <= len(examined) <= 512  # a serial line's buffer may begin within a packet now


def test_after_a_flood_the_next_step_reads_again() -> None:
    reader, writer = Reader((ATTITUDE,)), Writer(1, 1)
    for _ in range(300):
        reader.read(writer.pack(dialect.MAVLink_heartbeat_message(10, 12, 0, 0, 4, 3), 0), 0)
    assert reader.read(writer.pack(attitude(1), 0), 0) == []
    reader.begin_step()
    assert len(reader.read(writer.pack(attitude(2), 0), 0)) == 1


def test_a_datagram_is_ignored_from_its_first_bad_byte() -> None:
    reader, writer = Reader((ATTITUDE,)), Writer(1, 1)
    good = writer.pack(attitude(1), 0)
    assert len(reader.read(good + b"?" + good, 0)) == 1 and reader.counts.broken == 1


def test_a_wrong_checksum_is_rejected() -> None:
    reader, packet = Reader((ATTITUDE,)), bytearray(Writer(1, 1).pack(attitude(), 0))
    packet[12] ^= 1
    assert reader.read(bytes(packet), 0) == [] and reader.counts.broken == 1


class TestSignatures:
    def test_unsigned_and_wrongly_signed_packets_are_rejected(self) -> None:
        reader = Reader((ATTITUDE,), signatures())
        for packet in (Writer(1, 1).pack(attitude(), 0), signed(key=bytes(32))):
            assert reader.read(packet, 0) == []
        assert reader.counts.unsigned == 2
        assert len(reader.read(signed(), 0)) == 1

    def test_a_replayed_packet_is_rejected(self) -> None:
        reader = Reader((ATTITUDE,), signatures())
        old, new = signed(START_TICKS), signed(START_TICKS + 1)
        assert [len(reader.read(packet, 0)) for packet in (old, new, new, old)] == [1, 1, 0, 0]

    def test_a_packet_from_the_future_is_rejected_and_genuine_ones_still_count(self) -> None:
        checks = signatures()
        reader = Reader((ATTITUDE,), checks)
        assert reader.read(signed(START_TICKS + 61 * 100_000), 0) == [] and checks.from_future == 1
        assert len(reader.read(signed(START_TICKS + 1), 0)) == 1

    def test_a_forged_packet_leaves_no_trace(self) -> None:
        reader = Reader((ATTITUDE,), signatures())
        reader.read(signed(START_TICKS + 50 * 100_000, key=bytes(32)), 0)
        assert len(reader.read(signed(START_TICKS + 1), 0)) == 1

    def test_a_new_stream_may_be_one_minute_behind_and_no_more(self) -> None:
        reader = Reader((ATTITUDE,), signatures())
        assert len(reader.read(signed(START_TICKS - 59 * 100_000, link=1), 0)) == 1
        assert reader.read(signed(START_TICKS - 61 * 100_000, link=2), 0) == []

    def test_our_own_packets_have_growing_timestamps_of_the_clock(self) -> None:
        writer = Writer(1, 191, signatures())
        stamps = [int.from_bytes(writer.pack(attitude(), now_ns)[-12:-6], "little") for now_ns in (0, 0, S, S)]
        assert stamps == [START_TICKS + n for n in (0, 1, 100_000, 100_001)]
        assert Reader((ATTITUDE,), signatures()).read(writer.pack(attitude(), S), S) != []


class TestKeyFile:
    def test_bytes_and_hexadecimal_digits_are_read(self, tmp_path: Path) -> None:
        for name, content in (("raw", KEY), ("hex", KEY.hex().encode() + b"\n")):
            path = tmp_path / name
            path.write_bytes(content)
            path.chmod(0o600)
            assert read_key(path) == KEY

    @pytest.mark.parametrize(
        ("content", "mode", "complaint"),
        [(KEY, 0o640, "chmod 600"), (KEY[:31], 0o600, "32 bytes"), (b"x" * 64, 0o600, "32 bytes"), (b"", 0o600, "32")],
    )
    def test_a_bad_key_file_is_refused(self, tmp_path: Path, content: bytes, mode: int, complaint: str) -> None:
        path = tmp_path / "key"
        path.write_bytes(content)
        path.chmod(mode)
        with pytest.raises(ConfigError, match=complaint):
            read_key(path)

    def test_a_missing_key_file_is_refused(self, tmp_path: Path) -> None:
        with pytest.raises(ConfigError, match="expected a readable file"):
            read_key(tmp_path / "none")
