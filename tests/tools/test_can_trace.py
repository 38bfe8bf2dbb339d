"""The independent judge of a CAN trace finds every kind of error, and none in frames that the bridge makes."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from sim_hil.protocols.can.frames import Encoder
from tools.can_trace.check import DEFAULT_DBC as DBC
from tools.can_trace.check import judge, main


def trace(seconds: float = 2.0) -> list[str]:
    """A base and a controller that send every cyclic message in time."""
    from sim_hil.protocols.can.frames import database

    encoder, lines = Encoder(), []
    for message in database().messages:
        signals = {signal.name: 0.0 for signal in message.signals if signal.name not in ("Crc", "Counter")}
        if message.name == "VelocityCommand":
            signals["Vx"] = 0.3
        for index in range(round(seconds * 1000 / message.cycle_time) if message.cycle_time else 0):
            frame = encoder.encode(message.name, **signals)
            lines.append((index * message.cycle_time / 1000, f"can0 {frame.identifier:03X}#{frame.data.hex().upper()}"))
    return [f"({stamp:.6f}) {text}\n" for stamp, text in sorted(lines)]


def of(lines: list[str], identifier: str) -> list[int]:
    return [index for index, line in enumerate(lines) if f" {identifier}#" in line]


def test_a_good_trace_has_no_errors() -> None:
    result = judge(trace(), DBC)
    assert not any(result["wrong"].values()) and result["rare"] == [] and result["moving_commands"] == 100


@pytest.mark.parametrize("digit", range(5, 15))
def test_one_changed_digit_is_a_wrong_crc(digit: int) -> None:
    lines = trace()
    at = of(lines, "110")[5]
    head, _, data = lines[at].strip().partition("#")
    digit %= len(data)
    lines[at] = f"{head}#{data[:digit]}{'0' if data[digit] != '0' else '1'}{data[digit + 1 :]}\n"
    assert judge(lines, DBC)["wrong"]["crc"] == 1


def test_a_lost_and_a_repeated_frame_are_wrong_counters() -> None:
    lines = trace()
    lost, repeated = of(lines, "221")[3], of(lines, "230")[4]
    kept = [line for index, line in enumerate(lines) if index != lost]
    assert judge(kept, DBC)["wrong"]["counter"] == 1
    twice = [*lines[: repeated + 1], lines[repeated], *lines[repeated + 1 :]]
    assert judge(twice, DBC)["wrong"]["counter"] == 1


def test_a_message_that_stays_away_is_named() -> None:
    assert judge([line for line in trace() if " 701#" not in line], DBC)["rare"] == ["BaseHeartbeat"]


def test_an_identifier_of_no_message_is_counted() -> None:
    assert judge([*trace(), "(3.0) can0 7FF#00\n"], DBC)["wrong"]["unknown"] == 1


def test_a_trace_that_is_too_short_fails(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "trace.log"
    path.write_text("".join(trace()), encoding="ascii")
    assert main([str(path)]) == 0
    assert json.loads(capsys.readouterr().out)["duration_s"] == pytest.approx(2.0, abs=0.1)
    assert main([str(path), "--duration", "600"]) == 1


def test_a_line_that_is_no_frame_is_refused_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "trace.log"
    path.write_text("hello\n", encoding="ascii")
    assert main([str(path)]) == 2
    assert "line 1: expected (STAMP) CHANNEL ID#DATA" in capsys.readouterr().err


def test_the_judge_imports_nothing_of_this_project() -> None:
    from tools.can_trace import check

    text = Path(check.__file__).read_text(encoding="utf-8")
    assert not any(
        f"{word} {name}" in text for word in ("import", "from") for name in ("firmware_bridge", "sim_hil", "edge")
    )
