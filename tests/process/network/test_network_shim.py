"""The network shim: what happens to packets, by rule, over real sockets, and to DDS in a namespace of its own."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import socket
import statistics
import struct
import subprocess
import sys
import threading
import time
import zlib
from collections.abc import Iterator
from pathlib import Path

import can
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim_hil.network.config import LinkConfig, NetworkConfig, NetworkError
from sim_hil.network.impairment import Direction, Impairment
from sim_hil.network.ports import UdpEnds, can_frames
from sim_hil.network.relay import Relay
from tests.support.processes import REPOSITORY

PACKET = 100
N = 4000


def arrivals(rule: Impairment, count: int = N, *, seed: int = 1, every_s: float = 0.01) -> list[tuple[float, ...]]:
    direction = Direction(rule, (seed,))
    return [direction.offer(PACKET, index * every_s) for index in range(count)]


def lost(times: list[tuple[float, ...]]) -> list[bool]:
    return [not each for each in times]


class TestImpairment:
    def test_a_perfect_line_delivers_at_once_and_in_order(self) -> None:
        assert arrivals(Impairment(), 10) == [(index * 0.01,) for index in range(10)]

    def test_the_same_seed_gives_the_same_fate_and_another_one_does_not(self) -> None:
        rule = Impairment(loss_percent=20, jitter_ms=5, delay_ms=20, duplicate_percent=10, reorder_percent=5)
        assert arrivals(rule, seed=4) == arrivals(rule, seed=4)
        assert arrivals(rule, seed=4) != arrivals(rule, seed=5)

    @pytest.mark.slow
    @given(st.lists(st.floats(0, 1), min_size=50, max_size=50))
    def test_which_packets_are_lost_does_not_depend_on_when_they_come(self, gaps: list[float]) -> None:
        rule = Impairment(loss_percent=30, loss_burst=3, duplicate_percent=20)
        direction, now_s, fates = Direction(rule, (7,)), 0.0, []
        for gap in gaps:
            now_s += gap
            fates.append(len(direction.offer(PACKET, now_s)))
        assert fates == [len(each) for each in arrivals(rule, 50, seed=7)]

    @pytest.mark.parametrize("burst", [1.0, 5.0])
    def test_the_share_of_losses_is_what_was_asked_for(self, burst: float) -> None:
        share = sum(lost(arrivals(Impairment(loss_percent=20, loss_burst=burst)))) / N
        assert share == pytest.approx(0.2, abs=0.04)

    def test_losses_come_in_bursts_of_the_mean_length(self) -> None:
        pattern = "".join("x" if gone else "." for gone in lost(arrivals(Impairment(loss_percent=20, loss_burst=5))))
        lengths = [len(run) for run in pattern.split(".") if run]
        assert statistics.mean(lengths) == pytest.approx(5, rel=0.2)

    def test_nothing_passes_at_a_loss_of_100_percent(self) -> None:
        assert all(lost(arrivals(Impairment(loss_percent=100), 50)))

    def test_jitter_spreads_the_delay_and_keeps_the_order(self) -> None:
        times = [each[0] for each in arrivals(Impairment(delay_ms=50, jitter_ms=10))]
        assert times == sorted(times)
        delays = [time_s - index * 0.01 for index, time_s in enumerate(times)]
        assert statistics.mean(delays) == pytest.approx(0.05, abs=0.01)
        assert statistics.stdev(delays) > 0.004

    def test_reordered_packets_are_overtaken_and_no_others(self) -> None:
        rule = Impairment(delay_ms=5, reorder_percent=10, reorder_ms=15)
        delays = [round(each[0] - index * 0.01, 6) for index, each in enumerate(arrivals(rule))]
        assert set(delays) == {0.005, 0.020}
        assert delays.count(0.020) / N == pytest.approx(0.1, abs=0.02)

    def test_a_duplicate_arrives_besides_its_original(self) -> None:
        times = arrivals(Impairment(duplicate_percent=25))
        assert sum(len(each) == 2 for each in times) / N == pytest.approx(0.25, abs=0.03)

    def test_a_rate_limit_spaces_packets_and_drops_what_does_not_fit_its_queue(self) -> None:
        direction = Direction(Impairment(rate_kbps=8, queue_bytes=350), (1,))  # 1000 bytes a second
        times = [direction.offer(PACKET, 0.0) for _ in range(5)]
        assert times[:3] == [(pytest.approx(0.1),), (pytest.approx(0.2),), (pytest.approx(0.3),)]
        assert times[3:] == [(), ()] and direction.tally.queue_full == 2
        assert direction.offer(PACKET, 10.0) == (pytest.approx(10.1),)

    def test_nothing_passes_during_a_partition(self) -> None:
        times = arrivals(Impairment(partitions=((0.1, 0.2),)), 30)
        assert [index for index, each in enumerate(times) if not each] == list(range(10, 20))

    @pytest.mark.parametrize(
        "wrong", [{"loss_percent": 101}, {"delay_ms": -1}, {"jitter_ms": float("nan")}, {"loss_burst": 0.5},
                  {"partitions": ((2.0, 1.0),)}, {"rate_kbps": True}],
    )  # fmt: skip
    def test_what_cannot_be_is_refused(self, wrong: dict[str, object]) -> None:
        with pytest.raises(ValueError, match=next(iter(wrong))):
            Impairment(**wrong)  # type: ignore[arg-type]


@contextlib.contextmanager
def carrying(relay: Relay) -> Iterator[Relay]:
    """The relay at work in a thread."""
    ending = threading.Event()
    thread = threading.Thread(target=relay.run, args=(ending.is_set,))
    thread.start()
    try:
        yield relay
    finally:
        ending.set()
        thread.join()
        relay.close()


class Datagrams:
    """A relayed UDP link and sockets at its ends."""

    def __init__(self, there: Impairment, back: Impairment) -> None:
        self.server = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.server.bind(("127.0.0.1", 0))
        right = "{}:{}".format(*self.server.getsockname())
        link = LinkConfig("l", "udp", "127.0.0.1:0", right, there, back)
        self.relay = Relay(NetworkConfig((link,), seed=1))
        ends = self.relay.links["l"].ends
        assert isinstance(ends, UdpEnds)
        self.address = ends.address
        self._clients: list[socket.socket] = []

    def client(self) -> socket.socket:
        client = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        client.connect(self.address)
        self._clients.append(client)
        return client

    def close(self) -> None:
        for each in (self.server, *self._clients):
            each.close()


@contextlib.contextmanager
def datagrams(there: Impairment = Impairment(), back: Impairment = Impairment()) -> Iterator[Datagrams]:  # noqa: B008
    rig = Datagrams(there, back)
    with contextlib.closing(rig), carrying(rig.relay):
        yield rig


def received(end: socket.socket, quiet_s: float = 0.3) -> list[bytes]:
    """Everything that comes until nothing has come for a while."""
    end.settimeout(quiet_s)
    got = []
    with contextlib.suppress(TimeoutError):
        while True:
            got.append(end.recv(2000))
    return got


class TestDatagrams:
    def test_each_client_gets_its_own_answers(self) -> None:
        with datagrams() as rig:
            clients = [rig.client(), rig.client()]
            for index, client in enumerate(clients):
                client.send(b"%d" % index)
            for _ in clients:
                data, address = rig.server.recvfrom(100)
                rig.server.sendto(b"answer to " + data, address)
            assert [received(client) for client in clients] == [[b"answer to 0"], [b"answer to 1"]]

    def test_losses_and_duplicates_are_those_of_the_rule(self) -> None:
        rule = Impairment(loss_percent=30, duplicate_percent=20)
        expected = Direction(rule, (1, zlib.crc32(b"l"), 0))
        copies = [len(expected.offer(2, 0.0)) for _ in range(100)]
        with datagrams(there=rule) as rig:
            client = rig.client()
            for index in range(100):
                client.send(b"%02d" % index)
            got = received(rig.server)
            assert [got.count(b"%02d" % index) for index in range(100)] == copies
            tally = rig.relay.summary()["links"]["l"]["there"]
            assert (tally["packets"], tally["lost"]) == (100, copies.count(0))

    def test_a_delay_is_never_shorter_than_asked_for(self) -> None:
        with datagrams(back=Impairment(delay_ms=60)) as rig:
            client = rig.client()
            client.send(b"?")
            _, address = rig.server.recvfrom(10)
            start_ns = time.monotonic_ns()
            rig.server.sendto(b"!", address)
            assert received(client) == [b"!"]
            assert time.monotonic_ns() - start_ns >= 60_000_000

    def test_a_link_can_be_cut_and_joined_while_it_runs(self) -> None:
        with datagrams() as rig:
            client = rig.client()
            rig.relay.change(b'{"link": "l", "cut": true}')
            client.send(b"lost")
            assert received(rig.server) == []
            rig.relay.change(b'{"link": "*", "cut": false, "there": {"duplicate_percent": 100}}')
            client.send(b"kept")
            assert received(rig.server) == [b"kept", b"kept"]

    @pytest.mark.parametrize(
        "line", [b"", b"[]", b'{"link": "m", "cut": true}', b'{"link": "l", "cut": 1}', b'{"link": "l", "colour": 1}',
                 b'{"link": "l", "there": {"loss_percent": 200}}', b'{"link": "l", "there": 3}'],
    )  # fmt: skip
    def test_a_change_that_says_nothing_sensible_changes_nothing(self, line: bytes) -> None:
        with datagrams() as rig:
            with pytest.raises(NetworkError):
                rig.relay.change(line)
            client = rig.client()
            client.send(b"1")
            assert received(rig.server) == [b"1"]

    def test_a_peer_that_is_not_there_yet_is_only_silent(self) -> None:
        with datagrams() as rig:
            where = rig.server.getsockname()
            rig.server.close()
            client = rig.client()
            for _ in range(3):
                client.send(b"anybody?")
                time.sleep(0.02)
            rig.server = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            rig.server.bind(where)
            client.send(b"now")
            assert b"now" in received(rig.server)


class TestSerial:
    frames = st.lists(
        st.builds(
            lambda stamp, identifier, data: struct.pack("<BIBI", 0xAA, stamp, len(data), identifier) + data + b"\xbb",
            st.integers(0, 2**32 - 1), st.integers(0, 0x7FF), st.binary(max_size=8),
        ),
        max_size=6,
    )  # fmt: skip

    @given(frames, st.integers(1, 7))
    def test_frames_are_found_however_the_bytes_come(self, frames: list[bytes], chunk: int) -> None:
        data, rest, found = b"".join(frames), b"", []
        for start in range(0, len(data), chunk):
            more, rest = can_frames(rest + data[start : start + chunk])
            found += more
        assert (found, rest) == (frames, b"")

    @given(st.binary(max_size=60))
    def test_no_byte_is_lost_or_made_up(self, data: bytes) -> None:
        found, rest = can_frames(data)
        assert b"".join(found) + rest == data

    def test_a_line_loses_whole_frames_of_python_can_and_no_parts_of_them(self, tmp_path: Path) -> None:
        left, right = tmp_path / "left", tmp_path / "right"
        rule = Impairment(loss_percent=40)
        link = LinkConfig("l", "can-serial", str(left), str(right), there=rule)
        with carrying(Relay(NetworkConfig((link,), seed=2))) as relay:
            ends = [can.Bus(interface="serial", channel=str(path), timeout=0.3) for path in (left, right)]
            try:
                for index in range(40):
                    ends[0].send(
                        can.Message(arbitration_id=0x100 + index, data=bytes([index] * 8), is_extended_id=False)
                    )
                got = []
                while (message := ends[1].recv(0.5)) is not None:
                    got.append(message)
            finally:
                for end in ends:
                    end.shutdown()
            tally = relay.summary()["links"]["l"]["there"]
        assert all(message.data == bytes([message.arbitration_id - 0x100] * 8) for message in got)
        assert 10 < len(got) < 35 and len(got) == tally["delivered"] == 40 - tally["lost"]
        assert not left.exists() and not right.exists()


def _may_make_namespaces() -> bool:
    if os.geteuid() != 0 or shutil.which("ip") is None or shutil.which("unshare") is None:
        return False
    made = subprocess.run(["unshare", "--net", "ip", "link", "add", "v0", "type", "veth"], capture_output=True)
    return made.returncode == 0


@pytest.mark.skipif(not _may_make_namespaces(), reason="network namespaces and veth need root")
class TestCable:
    @staticmethod
    def between(folder: Path, rule: str, left: str, right: str) -> tuple[subprocess.CompletedProcess[str], dict]:
        (folder / "cable.toml").write_text(
            'seed = 5\n[[links]]\nname = "cable"\nkind = "frames"\nleft = "-"\nright = "-"\n'
            f"impairment = {{ {rule} }}\n"
        )
        command = [sys.executable, "-m", "sim_hil.network", "between", "cable.toml", "--left", left, "--right", right]
        environment = {**os.environ, "PYTHONPATH": str(REPOSITORY)}
        done = subprocess.run(
            [*command, "--json", "r.json"],
            cwd=folder, capture_output=True, text=True, timeout=100, env=environment, check=False,
        )  # fmt: skip
        return done, json.loads((folder / "r.json").read_text())["links"]["cable"]

    @pytest.mark.slow
    def test_dds_finds_its_robot_over_a_bad_cable_and_feels_it(self, tmp_path: Path) -> None:
        hil = "--robot go2 --scene corridor --protocol unitree --camera none --domain 0 --interface eth0"
        client = Path(__file__).with_name("network_dds_client.py")
        done, tally = self.between(
            tmp_path, "loss_percent = 5, delay_ms = 15",
            f"{sys.executable} -m sim_hil.hil.command {hil}", f"{sys.executable} {client} 0 eth0 2",
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        seen = json.loads(done.stdout)
        assert seen["rtt_min_ms"] >= 30
        assert seen["calls"] > 3
        assert tally["there"]["lost"] > 0 and tally["there"]["delivered"] > 50

    @pytest.mark.slow
    def test_a_signal_that_ends_the_right_command_is_its_exit_status(self, tmp_path: Path) -> None:
        done, _ = self.between(tmp_path, "delay_ms = 1", "sleep 60", "sh -c 'kill -9 $$'")
        assert done.returncode == 137, done.stderr

    @pytest.mark.slow
    def test_the_machines_own_network_is_left_alone(self, tmp_path: Path) -> None:
        before = subprocess.run(["ip", "-o", "link"], capture_output=True, text=True, check=True).stdout
        done, _ = self.between(tmp_path, "delay_ms = 1", "sleep 60", "sh -c 'ip -o addr show eth0; exit 7'")
        assert done.returncode == 7, done.stderr
        assert "192.168.123.99/24" in done.stdout
        after = subprocess.run(["ip", "-o", "link"], capture_output=True, text=True, check=True).stdout
        assert len(after.splitlines()) == len(before.splitlines())


class TestWhatMayNotEndTheRelay:
    def test_packets_under_way_are_bounded_in_bytes(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr("sim_hil.network.relay._MAX_WAITING_BYTES", 1000)
        link = LinkConfig("l", "udp", "127.0.0.1:0", "127.0.0.1:9", Impairment(delay_ms=600_000))
        relay = Relay(NetworkConfig((link,), 1))
        ends, (there, _) = relay.links["l"].ends, relay.links["l"].directions
        assert isinstance(ends, UdpEnds)
        with contextlib.closing(relay), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
            for _ in range(5):
                client.sendto(bytes(400), ends.address)
            while there.tally.packets < 5:
                relay.turn(0.01)
            assert there.tally.queue_full == 3
            relay._deliver(time.monotonic_ns() + 10**15)
            client.sendto(bytes(1000), ends.address)
            while there.tally.packets < 6:
                relay.turn(0.01)
            assert there.tally.queue_full == 3, "what has been handed out makes room again"

    @pytest.mark.parametrize("value", [10**400, 1e308, float("inf"), float("nan"), -1])
    def test_a_number_that_no_clock_can_count_is_refused(self, value: float) -> None:
        with pytest.raises(ValueError, match="delay_ms: expected"):
            Impairment(delay_ms=value)

    def test_an_address_that_no_way_leads_to_is_silence(self) -> None:
        # Without SO_BROADCAST nothing may be sent there: the call fails as it does while an interface is down.
        relay = Relay(
            NetworkConfig((LinkConfig("l", "udp", "127.0.0.1:0", "255.255.255.255:9", Impairment(), Impairment()),), 1)
        )
        ends = relay.links["l"].ends
        assert isinstance(ends, UdpEnds)
        with contextlib.closing(relay), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
            client.sendto(b"hello", ends.address)
            for _ in range(3):
                relay.turn(0.01)
            assert ends.sources()
