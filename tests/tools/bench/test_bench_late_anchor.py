"""The late-anchor benchmark: every variant in one run, every sample kept, nothing measured on a wrong command line."""

from __future__ import annotations

import os
import threading
from pathlib import Path

import pytest

from edge.artifacts.manifest import Artifacts
from tools.bench import late_anchor


@pytest.mark.slow
def test_every_variant_gets_as_many_generations_and_every_sample_is_kept(artifacts: Artifacts) -> None:
    niceness = os.getpriority(os.PRIO_PROCESS, threading.get_native_id())
    result = late_anchor.run(artifacts, rounds=2, alone_s=0.5)
    assert set(result["variants"]) == {"early", "late", "early, gives way", "late, gives way"}
    for samples in result["samples"].values():
        assert {len(values) for values in samples.values()} == {2}
    assert result["samples"]["early"]["late_anchor_ms"] == [0.0, 0.0]
    assert len(result["tick_samples_ms"]["alone"]) > 0
    assert result["tagged"] == "measured"
    assert late_anchor.report(result).count("\n") == 6
    assert os.getpriority(os.PRIO_PROCESS, threading.get_native_id()) == niceness


@pytest.mark.parametrize("wrong", [["--rounds", "0"], ["--alone", "0"], []])
def test_what_cannot_be_measured_is_refused_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], wrong: list[str]
) -> None:
    assert late_anchor.main(["--artifacts", str(tmp_path / "none"), *wrong]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1
