"""A log has the delay as it was and as the policy received it: people read the first, replay uses the second."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from edge.artifacts.manifest import load_artifacts
from edge.flightlog.part import LogPart, PartFile
from edge.flightlog.recorder import Recorder
from edge.flightlog.replay.records import RecordedTick, read_events
from edge.reasoning.generation_cycle import Mode
from tests.edge.flightlog.test_log_schemas import SAMPLES
from tests.edge.flightlog.test_replay import Log, drive


@pytest.mark.parametrize(("recorded", "given_s"), [({"delay_given_s": 10.0}, 10.0), ({}, 12.0)])
def test_the_delay_and_what_the_policy_received_are_both_read(
    tmp_path: Path, recorded: Mapping[str, float], given_s: float
) -> None:
    path = tmp_path / "flight.mcap"
    older = {key: value for key, value in SAMPLES["/tick"].items() if key != "delay_given_s"}
    part = LogPart(PartFile(path, new=False), 1)
    part.add("/run", 1, SAMPLES["/run"])
    part.add("/tick", 1, {**older, "delay_s": 12.0, **recorded})
    part.finish()
    part.file.close()
    (tick,) = read_events(path)
    assert isinstance(tick, RecordedTick) and (tick.delay_s, tick.delay_given_s) == (12.0, given_s)


class BeyondTraining(Recorder):
    """A recorder of a run whose real delay is far beyond what the policy received."""

    def put(self, topic: str, stamp_ns: int, payload: Any) -> None:
        """Record; a tick's real delay is changed."""
        late = topic == "/tick" and payload["delay_s"] is not None
        super().put(topic, stamp_ns, {**payload, "delay_s": 99.0} if late else payload)


@pytest.mark.slow
def test_replay_gives_the_policy_the_delay_that_it_received(artifacts_dir: Path, tmp_path: Path) -> None:
    recorder = BeyondTraining(tmp_path / "flight.mcap")
    drive(load_artifacts(artifacts_dir), recorder, Mode.ASYNC)
    assert recorder.close()
    code, result = Log([], tmp_path / "flight.mcap", artifacts_dir).replay()
    assert code == 0 and result["ticks"]["equal"] == result["ticks"]["driven"] > 0
