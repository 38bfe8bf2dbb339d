"""Release delays: a number, or a profile that is checked key by key."""

from __future__ import annotations

import json
import statistics
from pathlib import Path

import pytest

from edge.inference.release import ReleaseDelayError, parse_release_delay


def profile(path: Path, **content: object) -> str:
    path.write_text(json.dumps(content))
    return str(path)


def test_a_number_holds_every_generation_back_by_it() -> None:
    sample = parse_release_delay("2").sampler()
    assert [sample() for _ in range(3)] == [2.0, 2.0, 2.0]


def test_a_profile_has_its_mean_and_keeps_its_bounds(tmp_path: Path) -> None:
    file = profile(tmp_path / "p.json", schema=1, mean_s=2.0, sd_s=0.5, low_s=0.5, high_s=4.0, seed=3)
    sample = parse_release_delay(file).sampler()
    delays = [sample() for _ in range(2000)]
    assert statistics.mean(delays) == pytest.approx(2.0, abs=0.05)
    assert min(delays) >= 0.5
    assert max(delays) <= 4.0


def test_the_same_seed_gives_the_same_delays(tmp_path: Path) -> None:
    file = profile(tmp_path / "p.json", schema=1, mean_s=2.0, sd_s=0.5, seed=3)
    first, second = parse_release_delay(file).sampler(), parse_release_delay(file).sampler()
    assert [first() for _ in range(5)] == [second() for _ in range(5)]


@pytest.mark.parametrize("bad", ["-1", "nan", "inf", "1e9", "no-such-file.json"])
def test_an_invalid_delay_is_refused(bad: str) -> None:
    with pytest.raises(ReleaseDelayError):
        parse_release_delay(bad)


@pytest.mark.parametrize(
    "content",
    [
        {},
        {"schema": 2, "mean_s": 1},
        {"schema": 1},
        {"schema": 1, "mean_s": 1, "mean_ms": 1},
        {"schema": 1, "mean_s": "1"},
        {"schema": 1, "mean_s": True},
        {"schema": 1, "mean_s": 1, "seed": 0.5},
        {"schema": 1, "mean_s": 5, "high_s": 4},
        {"schema": 1, "mean_s": 5, "sd_s": 1e-200},
        {"schema": 1, "mean_s": 5, "sd_s": 1e300},
        {"schema": 1, "mean_s": 10**400},
    ],
)
def test_a_wrong_profile_is_refused(tmp_path: Path, content: dict[str, object]) -> None:
    with pytest.raises(ReleaseDelayError):
        parse_release_delay(profile(tmp_path / "p.json", **content))
