"""The memory benchmark: growth per operation and per hour, and the parts that it measures."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tools.memory.__main__ import main
from tools.memory.gauge import MIB, growth, later_half, read_own
from tools.memory.parts import PARTS, Workshop
from tools.memory.stack import judged, longest_lives, table, trends_of


def reading(t_s: float, private: float) -> dict[str, int]:
    sizes = dict.fromkeys(("rss", "pss", "anonymous", "heap_used", "heap_free"), 100 * MIB)
    return {"t_ns": round(t_s * 1e9), "private_dirty": round(private * MIB), **sizes}


def test_growth_counts_the_later_half_of_the_operations() -> None:
    readings = [{"heap_used": 5000 if done < 20 else 5000 + 3 * done, "blocks": 7, "rss": done} for done in range(40)]
    found = growth("part", 3600, list(range(40)), readings)
    assert found.heap_bytes == pytest.approx(3.0) and found.blocks == pytest.approx(0.0, abs=1e-9)
    assert found.rss_mib_per_h == pytest.approx(3600 / MIB)


def test_a_process_that_certainly_grows_by_more_than_the_limit_is_named() -> None:
    grows = [reading(t, 200 + 2 * t / 3600 + 0.001 * (t % 3)) for t in range(0, 600, 2)]
    steady = [reading(t, 200 + 0.001 * (t % 3)) for t in range(0, 600, 2)]
    trends = trends_of({"edge-run": grows, "edge-bridge": steady})
    assert judged(trends) == ["edge-run"]
    own = trends["edge-run"]["private_dirty"]
    assert own is not None and own.per_h == pytest.approx(2.0, abs=0.05) and own.low < 2.0 < own.high
    assert any("+2.00" in line for line in table(trends))


def test_few_readings_have_no_trend() -> None:
    assert later_half([reading(t, 1.0) for t in range(12)], "rss") is None


def test_the_longest_life_of_a_process_counts_without_its_start(tmp_path: Path) -> None:
    for name, seconds in (("edge-run-1", 40), ("edge-run-2", 100), ("edge-bridge", 60)):
        lines = [json.dumps(reading(t, 1.0)) for t in range(seconds)]
        (tmp_path / f"memory-{name}.jsonl").write_text("\n".join(lines))
    found = longest_lives(tmp_path)
    assert {name: len(own) for name, own in found.items()} == {"edge-run": 70, "edge-bridge": 30}


def test_a_process_reads_its_own_memory() -> None:
    before = read_own()
    kept = [bytearray(1000) for _ in range(5000)]
    after = read_own()
    assert after["heap_used"] - before["heap_used"] >= 1000 * len(kept)
    assert after["blocks"] - before["blocks"] >= len(kept) and after["rss"] > 0


@pytest.mark.parametrize("wrong", [["--operations", "3"], ["--stack", "0"], ["--artifacts", "none"]])
def test_bad_arguments_are_refused_in_one_line(
    wrong: list[str], artifacts_dir: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert _code(["--artifacts", str(artifacts_dir), *wrong]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def _code(arguments: list[str]) -> int:
    try:
        return main(arguments)
    except SystemExit as error:
        assert isinstance(error.code, int)
        return error.code


@pytest.mark.slow
@pytest.mark.parametrize(
    ("part", "warm", "operations", "heap_bytes", "blocks"),
    [("camera", 200, 400, 200, 1), ("odometry", 100, 200, 500, 2), ("tick", 100, 200, 500, 2)],
)
def test_a_part_of_the_runner_keeps_nothing_of_an_operation(
    part: str, warm: int, operations: int, heap_bytes: int, blocks: int, artifacts_dir: Path
) -> None:
    with PARTS[part].open(Workshop(artifacts_dir, 0)) as operation:
        for number in range(warm):
            operation(number)
        before = read_own()
        for number in range(warm, warm + operations):
            operation(number)
        after = read_own()
    assert (after["heap_used"] - before["heap_used"]) / operations < heap_bytes
    assert (after["blocks"] - before["blocks"]) / operations < blocks


@pytest.mark.slow
def test_a_generation_keeps_no_more_than_its_bounded_memories_take(artifacts_dir: Path) -> None:
    with PARTS["generation"].open(Workshop(artifacts_dir, 0)) as operation:
        for number in range(30):
            operation(number)
        before = read_own()
        for number in range(30, 60):
            operation(number)
        after = read_own()
    # The path's points, guesses from earlier texts and the tokenizer's words; an arena of ONNX Runtime doubles at most.
    assert after["blocks"] - before["blocks"] < 30 * 40
    assert after["heap_used"] - before["heap_used"] < 17 * MIB
