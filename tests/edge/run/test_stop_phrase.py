"""Stop phrases: what counts as one, and that the instruction channel stops the robot by it and hands nothing on."""

from __future__ import annotations

import json
import socket
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge.deploy.install import main as install_main
from edge.reasoning.prompt import InstructionError
from edge.robot.arming import disarm
from edge.run.command import main as run_main
from edge.run.instructions import InstructionSocket, check_first_instruction
from edge.run.stop_phrase import COMPANIONS, STOP_WORDS, is_stop_phrase
from firmware_bridge.client import BridgeStatus, BridgeUnavailable
from firmware_bridge.core.link import Stop
from tests.support.processes import GO2_SIM
from tests.support.robot.bridge_bench import Bench

BRIDGE = Path("/nowhere/bridge.sock")
PHRASES = [
    *("stop", "halt", "freeze", "emergency stop", "stop now", "e-stop", "E-Stop!", "estop", "STOP", "  Stop.  "),
    *("stop!!!", "stop, stop, STOP", "please stop", "stop immediately", "stop right now", "stop the robot"),
    *("robot, stop moving", "¡stop!", "st\u200bop", "\uff33\uff34\uff2f\uff30", "stop\n", "“Halt”"),
]
INSTRUCTIONS = [
    *("stop at the vending machine", "go down the corridor and stop", "stop, then turn left", "don't stop"),
    *(
        "do not stop",
        "stopover",
        "never stop",
        "stop<|im_end|>",
        "now",
        "robot",
        "the emergency exit",
        "",
        "!",
        "nonstop",
    ),
    *("stop at the second door", "halt at the lift", "go on", "the bus stop"),
]


@pytest.mark.parametrize("text", PHRASES)
def test_a_stop_word_alone_is_a_stop_phrase(text: str) -> None:
    assert is_stop_phrase(text)


@pytest.mark.parametrize("text", INSTRUCTIONS)
def test_a_text_with_any_other_word_is_an_instruction(text: str) -> None:
    assert not is_stop_phrase(text)


@given(
    st.lists(st.sampled_from(sorted(STOP_WORDS | COMPANIONS)), min_size=1, max_size=6),
    st.sampled_from([" ", "  ", ", ", "! ", "\t", " – "]),
    st.booleans(),
)
def test_case_punctuation_and_order_do_not_matter(words: list[str], between: str, upper: bool) -> None:
    text = between.join(word.upper() if upper else word for word in words)
    assert is_stop_phrase(text) == bool(STOP_WORDS & set(words))


@pytest.mark.parametrize("text", PHRASES)
def test_no_run_begins_with_a_stop_phrase(text: str) -> None:
    with pytest.raises(InstructionError, match="is a stop phrase"):
        check_first_instruction(text)


def test_edge_run_refuses_a_stop_phrase_as_its_instruction(capfd: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert run_main(["--artifacts", str(tmp_path), "--robot", str(GO2_SIM), "--instruction", "Stop!"]) == 2
    assert "is a stop phrase" in capfd.readouterr().err


def test_edge_install_refuses_a_service_whose_instruction_is_a_stop_phrase(
    artifacts_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = ["--artifacts", str(artifacts_dir), "--robot", str(GO2_SIM), "--out", str(tmp_path), "--arm-at-start"]
    assert install_main(["units", *options, "--instruction", "halt"]) == 2
    assert "is a stop phrase" in capsys.readouterr().err


class Channel:
    """An instruction socket and a person at the other end; `stops` counts how often the robot was stopped."""

    def __init__(self, folder: Path) -> None:
        self.stops = 0
        self.confirms = True
        self.socket = InstructionSocket(folder / "say", lambda _text: None, self._stop, BRIDGE)
        self._person = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._person.bind(str(folder / "person"))
        self._person.setblocking(False)
        self._path = folder / "say"

    def _stop(self) -> bool:
        self.stops += 1
        return self.confirms

    def say(self, *texts: str) -> str | None:
        """Send these before the runner looks; the instruction that the model is given."""
        for text in texts:
            self._person.sendto(json.dumps({"instruction": text}).encode(), str(self._path))
        return self.socket.poll()

    def answers(self) -> list[dict[str, object]]:
        found = []
        while True:
            try:
                found.append(json.loads(self._person.recv(65_536)))
            except BlockingIOError:
                return found

    def close(self) -> None:
        self.socket.close()
        self._person.close()


@pytest.fixture
def channel(tmp_path: Path) -> Iterator[Channel]:
    channel = Channel(tmp_path)
    yield channel
    channel.close()


@pytest.mark.parametrize("confirms", [True, False])
def test_a_stop_phrase_stops_the_robot_and_its_sender_learns_whether_that_is_confirmed(
    channel: Channel, confirms: bool
) -> None:
    channel.confirms = confirms
    assert channel.say("Stop!") is None
    assert channel.stops == 1 and channel.socket.stopped
    assert channel.answers() == [{"stopped": "Stop!", "confirmed": confirms, "bridge": str(BRIDGE)}]


def test_a_stop_phrase_beside_instructions_wins_in_any_order(channel: Channel) -> None:
    assert channel.say("go on", "stop", "turn left") is None
    assert channel.stops == 1
    assert [sorted(answer) for answer in channel.answers()] == [
        ["accepted"],
        ["bridge", "confirmed", "stopped"],
        ["error"],
    ]


def test_after_a_stop_phrase_no_instruction_is_accepted(channel: Channel) -> None:
    channel.say("stop")
    channel.answers()
    assert channel.say("go on") is None
    (answer,) = channel.answers()
    assert "start a new one" in str(answer["error"])


def test_a_stop_phrase_that_is_repeated_stops_again(channel: Channel) -> None:
    channel.say("stop")
    channel.say("stop")
    assert channel.stops == 2


def test_an_instruction_with_a_stop_word_reaches_the_model(channel: Channel) -> None:
    assert channel.say("stop at the vending machine") == "stop at the vending machine"
    assert channel.stops == 0 and not channel.socket.stopped


class Commander:
    """A runner's end of a bridge core; the first `loses` stops get lost, `poll` is the bridge's side."""

    def __init__(self, bench: Bench, loses: int = 0, poll: Callable[[], BridgeStatus] | None = None) -> None:
        self.bench, self.loses = bench, loses
        self.poll = poll or (lambda: bench.status)

    def stop(self) -> bool:
        self.loses -= 1
        if self.loses < 0:
            self.bench.step(Stop())
        return self.loses < 0

    def disarm(self) -> bool:
        return disarm(self, limit_s=1.0, clock=lambda: self.bench.now_ns, sleep=lambda s: self.bench.wait(s * 1e3))


def test_the_runners_stop_is_confirmed_by_the_bridge_and_stays_until_a_new_arm() -> None:
    bench = Bench().arm()
    bench.drive(300)
    assert Commander(bench).disarm() and bench.status.cause == "client_stop"
    bench.written.clear()
    bench.drive(2000)
    assert bench.status.state == "stopped" and all(move.vx_mps == 0.0 for move in bench.moves())


def test_the_runners_stop_is_repeated_until_it_arrives() -> None:
    bench = Bench().arm()
    bench.drive(300)
    assert Commander(bench, loses=5).disarm() and bench.status.cause == "client_stop"


def test_a_bridge_that_hangs_confirms_no_stop_and_is_not_waited_for_long() -> None:
    bench = Bench().arm()
    bench.drive(300)
    last, began_ns = bench.status, bench.now_ns
    assert not Commander(bench, loses=10**6, poll=lambda: last).disarm()
    assert bench.now_ns - began_ns <= 1.1e9


def test_a_status_from_before_the_stop_confirms_nothing() -> None:
    bench = Bench().arm()
    bench.step(Stop())
    before = bench.status
    bench.wait(20)
    assert before.state == "stopped" and not Commander(bench, poll=lambda: before).disarm()


def test_a_bridge_that_has_gone_confirms_no_stop() -> None:
    def gone() -> BridgeStatus:
        raise BridgeUnavailable("the bridge has closed the connection")

    assert not Commander(Bench().arm(), poll=gone).disarm()
