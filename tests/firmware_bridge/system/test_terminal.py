"""Messages for a terminal are one printable line, whatever a file or a command line contains."""

from __future__ import annotations

import pytest

from firmware_bridge.system.terminal import LONGEST_LINE, CommandParser, one_line


def test_escape_sequences_and_line_ends_are_written_as_text() -> None:
    assert one_line("a\x1b[2J\nb") == "a\\x1b[2J\\nb"


def test_other_languages_stay_readable() -> None:
    assert one_line("gehe zur Tür, 走") == "gehe zur Tür, 走"


@pytest.mark.parametrize("middle", ["x" * 100_000, "\x1b" * 100_000, "\x1b" * 400])
def test_a_long_message_keeps_its_beginning_and_its_end(middle: str) -> None:
    line = one_line(f"begin{middle}end")
    assert len(line) <= LONGEST_LINE and line.startswith("begin") and line.endswith("end")


def test_an_unknown_argument_with_an_escape_sequence_is_one_printable_line(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        CommandParser("edge-x").parse_args(["\x1b[2J\n"])
    assert ended.value.code == 2 and capsys.readouterr().err.splitlines()[-1].endswith("\\x1b[2J\\n")


def test_two_dashes_are_no_value_of_an_option(capsys: pytest.CaptureFixture[str]) -> None:
    parser = CommandParser("edge-x")
    parser.add_argument("--number", type=int)
    with pytest.raises(SystemExit):
        parser.parse_args(["--number=--"])
    assert "argument --number: expected a value" in capsys.readouterr().err
