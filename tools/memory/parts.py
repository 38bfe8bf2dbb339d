"""The runner's parts as operations that repeat: each is the product's own code on made inputs."""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import MappingProxyType

import numpy as np

from edge.artifacts.manifest import Artifacts, load_artifacts
from edge.core.geometry import SE2
from edge.flightlog.recorder import Recorder
from edge.inference.generation_task import GenerationModels, GenerationTask
from edge.inference.graph import Interrupt
from edge.inference.warm_up import Opened, open_proven, warm_up
from edge.odometry.camera_geometry import Attitude, CameraGeometry
from edge.odometry.estimator import DriftEstimator
from edge.odometry.gate import OdometryInputs
from edge.odometry.visual_odometry import VisualOdometry, grey_frame
from edge.reasoning.instruction_state import InstructionMemory, Job
from edge.robot.camera import decode_frame
from edge.state.pose_history import PoseHistory
from edge.state.ring import EncodedFrame, TokenRing
from edge.state.semantic import SemanticState
from edge.state.switches import Speculation
from sim_hil.realtime.stack import INSTRUCTION
from tools.memory.samples import picture

Operation = Callable[[int], None]
"""One operation; it takes its number."""
_TICK_NS = 100_000_000
_NEW_FRAMES = 20
"""Ticks between two generations: about 2 s."""
_HERE = SE2(0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Workshop:
    """What parts share: the artifacts, opened once when a part needs them, and a DDS domain."""

    directory: Path | None
    domain: int

    @cached_property
    def opened(self) -> Opened:
        """The graphs, opened and warmed up as the runner does. Raises ArtifactError."""
        opened = open_proven(self.artifacts)
        warm_up(opened.policy, opened.language, Speculation.ON)
        return opened

    @cached_property
    def artifacts(self) -> Artifacts:
        """The artifacts. Raises ArtifactError."""
        assert self.directory is not None
        return load_artifacts(self.directory)


@dataclass(frozen=True)
class Part:
    """One part: how it opens, operations an hour in a real run, and operations of a measurement."""

    open: Callable[[Workshop], AbstractContextManager[Operation]]
    per_h: int
    operations: int
    what: str


@contextmanager
def _tick(workshop: Workshop) -> Iterator[Operation]:
    policy, runtime = workshop.opened.policy, workshop.artifacts.runtime
    kv = np.ones((1, 200, runtime.kv_dim), dtype=np.float32)
    semantic = SemanticState(0, 0, _HERE, 0, kv, policy.semantic_context(kv), "", None)
    ring = TokenRing(160, policy.tokens_shape)
    frames = [decode_frame(picture(number), runtime.image_px) for number in range(16)]

    def tick(number: int) -> None:
        tokens = policy.encode(frames[number % len(frames)], ring.next_buffer())
        ring.put(EncodedFrame(number * _TICK_NS, _HERE, tokens))
        policy.act(tokens, (0.4, 0.0, 0.0), 2.0, _HERE, semantic)

    yield tick


@contextmanager
def _generation(workshop: Workshop) -> Iterator[Operation]:
    opened, runtime = workshop.opened, workshop.artifacts.runtime
    policy, language = opened.policy, opened.language
    models, ring = GenerationModels(language, policy), TokenRing(160, policy.tokens_shape)
    job = Job(0, INSTRUCTION, InstructionMemory(None, INSTRUCTION))
    tokens = [policy.encode(decode_frame(picture(number), runtime.image_px)) for number in range(16)]

    def generation(number: int) -> None:
        for tick in range(number * _NEW_FRAMES, (number + 1) * _NEW_FRAMES):
            pose = SE2(0.05 * tick, float(np.sin(tick / 60)), float(0.3 * np.sin(tick / 70)))
            buffer = ring.next_buffer()
            assert buffer is not None
            buffer[...] = tokens[tick % len(tokens)]
            ring.put(EncodedFrame((tick + 1) * _TICK_NS, pose, buffer))
        job.memory.watch(ring)
        newest_ns, interrupt = ring.newest_ns, Interrupt()
        assert newest_ns is not None
        task = GenerationTask(models, job, runtime.max_new_tokens)
        run = language.begin(lambda: False, interrupt=interrupt)
        for offset_s in sorted(runtime.frame_offsets_s, reverse=True):
            frame = ring.nearest(newest_ns - round(offset_s * 1e9)) if offset_s > 0 else None
            if frame is not None:
                task.older.append(frame)
                task.prefill(run, len(task.older), frame)
        anchor = ring.nearest(newest_ns)
        assert anchor is not None
        task.set_anchor(anchor, ring)
        result = task.finish(run, interrupt)
        state = task.publish(result, number=number, ready_ns=newest_ns, text_complete=True)
        policy.act(anchor.tokens, (0.4, 0.0, 0.0), 2.0, _HERE, state)

    yield generation


@contextmanager
def _camera(workshop: Workshop) -> Iterator[Operation]:
    def decode(number: int) -> None:
        decode_frame(picture(number), 128)

    yield decode


@contextmanager
def _odometry(workshop: Workshop) -> Iterator[Operation]:
    eye = VisualOdometry(CameraGeometry(1.7, 0.3, 0.1, 0.3))

    def see(number: int) -> None:
        grey = grey_frame(picture(number))
        assert grey is not None
        eye.step(grey, number * _TICK_NS, Attitude())

    yield see


@contextmanager
def _estimator(workshop: Workshop) -> Iterator[Operation]:
    estimator, history = DriftEstimator(), PoseHistory()

    def report(number: int) -> None:
        now_ns, theta = (number + 1) * 20_000_000, 0.006 * number
        pose = (float(np.sin(theta)), float(1.0 - np.cos(theta)), float(np.remainder(theta + np.pi, 2 * np.pi) - np.pi))
        outputs = estimator.step(OdometryInputs(now_ns, pose, 0.3, 0.0, 0.3, 0.3, robot_stamp_ns=now_ns), now_ns)
        if outputs.pose is not None:
            history.put(outputs.pose)
        estimator.motion_offset(now_ns - 5_000_000_000)

    yield report


@contextmanager
def _recorder(workshop: Workshop) -> Iterator[Operation]:
    with tempfile.TemporaryDirectory(prefix="tic-memory-") as folder:
        recorder = Recorder(Path(folder) / "flight.mcap")

        def record(number: int) -> None:
            stamp_ns = time.monotonic_ns()
            recorder.put("/camera", stamp_ns, picture(number))
            recorder.put("/tick", stamp_ns, {"tick": number, "trajectory": [[0.1] * 3] * 3, "command": (0.1, 0.0, 0.0)})
            for _ in range(5):
                recorder.put("/odometry", stamp_ns, {"raw_pose": (0.1, 0.2, 0.3), "velocity": (0.1, 0.0, 0.0)})
            time.sleep(0.002)

        yield record
        recorder.close()


@contextmanager
def _states(workshop: Workshop) -> Iterator[Operation]:
    from firmware_bridge.core.config import DdsConfig
    from firmware_bridge.dds.bus import Bus, take_each
    from firmware_bridge.unitree.messages.idl import SportModeState_
    from firmware_bridge.unitree.messages.ids import SPORT_STATE_TOPIC
    from firmware_bridge.unitree.report import robot_state

    command = [sys.executable, "-m", "tools.memory.publisher", str(workshop.domain)]
    with subprocess.Popen(command, stdin=subprocess.PIPE) as publisher:
        bus = Bus(DdsConfig(interface="lo", domain=workshop.domain, peers=("127.0.0.1",)))
        reader = bus.reader(SPORT_STATE_TOPIC, SportModeState_)
        waitset = bus.waitset(reader)

        def take(number: int) -> None:
            waitset.wait(100_000_000)
            for sample in take_each(reader):
                robot_state(sample, time.monotonic_ns(), "base")

        try:
            yield take
        finally:
            bus.close()
            publisher.kill()


PARTS: Mapping[str, Part] = MappingProxyType(
    {
        "tick": Part(_tick, 36_000, 20_000, "encoder and action expert on one frame"),
        "generation": Part(_generation, 3_600, 1_000, "a generation, its context and the new semantic state"),
        "camera": Part(_camera, 36_000, 100_000, "a JPEG decoded and scaled"),
        "odometry": Part(_odometry, 36_000, 30_000, "visual odometry on one picture"),
        "estimator": Part(_estimator, 180_000, 200_000, "a report through the drift estimator"),
        "recorder": Part(_recorder, 36_000, 30_000, "a tick's records in the flight log"),
        "states": Part(_states, 180_000, 200_000, "a state from another process by DDS"),
    }
)
"""The parts by name."""
