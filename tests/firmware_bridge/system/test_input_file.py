"""Small input files: what is read, and what is refused before it can hang, fill the memory or end by a traceback."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from firmware_bridge.system.input_file import MAX_INTEGER, parse_json, parse_toml, read_bytes, read_json, read_toml


def test_a_small_file_is_read(tmp_path: Path) -> None:
    (tmp_path / "a.toml").write_text("a = 1")
    (tmp_path / "a.json").write_text('{"a": 1}')
    assert read_toml(tmp_path / "a.toml") == read_json(tmp_path / "a.json") == {"a": 1}


def test_a_fifo_is_refused_and_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "fifo")
    with pytest.raises(OSError, match="not a regular file"):
        read_bytes(tmp_path / "fifo")


def test_an_endless_device_is_refused() -> None:
    with pytest.raises(OSError, match="not a regular file"):
        read_bytes(Path("/dev/zero"))


def test_a_file_that_is_too_large_is_not_read_into_memory(tmp_path: Path) -> None:
    with (tmp_path / "sparse").open("wb") as file:
        file.truncate(10**10)
    with pytest.raises(OSError, match="larger than 1000 bytes"):
        read_bytes(tmp_path / "sparse", 1000)


def test_a_directory_is_refused(tmp_path: Path) -> None:
    with pytest.raises(IsADirectoryError):
        read_bytes(tmp_path)


@pytest.mark.parametrize("text", ["[" * 100_000 + "]" * 100_000, '{"a":' * 100_000 + "1" + "}" * 100_000])
def test_deep_json_is_a_value_error(text: str) -> None:
    with pytest.raises(ValueError, match="nested too deeply"):
        parse_json(text)


@pytest.mark.parametrize("number", [MAX_INTEGER + 1, -MAX_INTEGER - 1, 10**400])
def test_an_integer_of_json_that_would_overflow_a_float_or_64_bits_is_a_value_error(number: int) -> None:
    with pytest.raises(ValueError, match=rf"an integer of \d+ bits, expected at most {MAX_INTEGER}"):
        parse_json(f'{{"a": [1.5, {{"b": {number}}}]}}')


def test_a_stamp_in_nanoseconds_is_read_from_json() -> None:
    assert parse_json(f"[{MAX_INTEGER}, {-MAX_INTEGER}]") == [MAX_INTEGER, -MAX_INTEGER]


def test_deep_toml_lists_are_a_value_error() -> None:
    with pytest.raises(ValueError, match="nested too deeply"):
        parse_toml("a = " + "[" * 100_000 + "]" * 100_000)


def test_a_toml_key_of_many_parts_is_refused_before_its_square_is_computed() -> None:
    with pytest.raises(ValueError, match="nested too deeply"):
        parse_toml("[" + "a." * 100_000 + "a]\nb = 1\n")


def test_points_in_values_are_no_key_parts() -> None:
    numbers = ", ".join(["0.5"] * 5000)
    assert len(parse_toml(f"a = [{numbers}]")["a"]) == 5000
