"""What the runner's own two loops record is enough to run them again bit for bit."""

from __future__ import annotations

import json
import math
import threading
from dataclasses import asdict
from pathlib import Path

import pytest

from edge.artifacts.manifest import Artifacts, load_artifacts
from edge.core.geometry import SE2
from edge.flightlog.reader import read_messages
from edge.flightlog.recorder import Recorder
from edge.flightlog.replay.command import main
from edge.flightlog.schemas import SCHEMAS
from edge.inference.generation_task import GenerationModels
from edge.inference.language import LanguageModel
from edge.inference.policy import Policy
from edge.motion.controller import Controller, ControllerConfig
from edge.reasoning.generation_cycle import Mode, ReasoningConfig
from edge.run.camera import decode_frame
from edge.run.control_loop import CommandChain, ControlConfig, ControlLoop, ControlOutputs, ControlSources
from edge.run.reasoning_loop import ReasoningLoop, ReasoningOutputs, ReasoningSchedule
from edge.state.frame import Frame
from edge.state.pose_history import PoseHistory, StampedPose
from edge.state.ring import TokenRing
from edge.state.semantic import SemanticSlot, SharedState
from firmware_bridge.core.config import LimitsConfig
from tests.edge.flightlog.test_log_schemas import complaints
from tests.support.runner import synthetic_run

TICKS = 60
TICK_NS = 100_000_000
LIMITS = LimitsConfig(
    vx_min_mps=-0.4, vx_max_mps=0.8, vy_max_mps=0.3, wz_max_radps=1.0, accel_mps2=1.0, alpha_radps2=2.0
)


class Sink:
    """A bridge that takes everything and says nothing."""

    def send_velocity(self, seq: int, stamp_ns: int, vx_mps: float, vy_mps: float, wz_radps: float) -> bool:
        return True

    def poll(self) -> None:
        return None


def drive(artifacts: Artifacts, recorder: Recorder, mode: Mode) -> None:
    """Both loops in one thread on a clock that moves by ticks; a generation after every 15th."""
    runtime = artifacts.runtime
    now_ns = synthetic_run.START_NS
    policy, language = Policy(artifacts), LanguageModel(artifacts)
    slot, ring, history, stop = SemanticSlot(), TokenRing(130), PoseHistory(), threading.Event()
    frame: Frame | None = None
    shared = SharedState(ring, slot)
    reasoning = ReasoningLoop(
        GenerationModels(language, policy),
        shared,
        ReasoningConfig(runtime.frame_offsets_s, 6, mode),
        "walk down the corridor",
        stop=stop,
        schedule=ReasoningSchedule(late_anchor=False),
        outputs=ReasoningOutputs(recorder),
        clock=lambda: now_ns,
    )
    control = ControlLoop(
        policy,
        ControlConfig(TICK_NS, runtime.step_s),
        ControlSources(lambda: frame, history),
        shared,
        CommandChain.standard(Controller(ControllerConfig(LIMITS, runtime.step_s, 500, 200)), TICK_NS),
        ControlOutputs(Sink(), recorder),  # type: ignore[arg-type]
        stop=stop,
        clock=lambda: now_ns,
    )
    record = {
        "instruction": "walk down the corridor",
        "mode": mode.value,
        "artifacts": str(artifacts.directory),
        "manifest_sha256": artifacts.manifest_sha256,
        "robot": "go2",
        "limits": asdict(LIMITS),
        "release_delay": {},
        "started_ns": now_ns,
        "tick_period_ms": 100,
    }
    recorder.put("/run", now_ns, record)
    for tick in range(TICKS):
        now_ns += TICK_NS
        pose = SE2(0.04 * tick, 0.01 * tick, 0.05 * math.sin(tick))
        history.put(StampedPose(now_ns - 10_000_000, pose, 0.4, 0.0, 0.05 * math.cos(tick)))
        jpeg = synthetic_run.jpeg(tick / 10)
        frame = Frame(now_ns - 40_000_000, decode_frame(jpeg, runtime.image_px), jpeg)
        control.tick(now_ns)
        if tick % 15 == 14:
            assert reasoning.step()


@pytest.mark.parametrize("mode", [Mode.ASYNC, Mode.NO_REASONING], ids=lambda mode: mode.value)
def test_a_run_of_both_loops_is_replayed_bit_for_bit(artifacts_dir: Path, tmp_path: Path, mode: Mode) -> None:
    flight, out = tmp_path / "flight.mcap", tmp_path / "replay.json"
    recorder = Recorder(flight)
    drive(load_artifacts(artifacts_dir), recorder, mode)
    assert recorder.close() and recorder.dropped == {}

    for topic, _, payload in read_messages(flight):
        assert complaints(payload, SCHEMAS[topic]) == []
    assert main([str(flight), "--artifacts", str(artifacts_dir), "--json", str(out)]) == 0
    result = json.loads(out.read_text())
    assert result["ticks"]["equal"] == result["ticks"]["compared"] == TICKS - 15
    assert result["generations"] == {
        "compared": 4, "texts_equal": 4, "different": [], "poses_interpolated": 0, "ways_from_frames": 0
    }  # fmt: skip
    assert result["commands"]["compared"] == TICKS
    assert result["skipped"] == {}
