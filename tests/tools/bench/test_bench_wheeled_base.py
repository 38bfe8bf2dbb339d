"""The wheeled base's benchmark: what it is asked for is checked before anything runs."""

from __future__ import annotations

import pytest

from tools.bench import wheeled_base


@pytest.mark.parametrize(
    "arguments",
    [
        ["--rate", "0"],
        ["--rate", "-240"],
        ["--rate", "100000"],
        ["--minutes", "0"],
        ["--minutes", "nan"],
        ["--minutes", "inf"],
        ["--repeats", "0"],
        ["--json", "/"],
    ],
)
def test_arguments_that_make_no_sense_are_refused_in_one_line(
    arguments: list[str], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(wheeled_base, "run", lambda *_: pytest.fail("it has begun"))
    assert wheeled_base.main(arguments) == 2
    message = capsys.readouterr().err
    assert len(message.splitlines()) == 1 and arguments[0] in message and "expected" in message
