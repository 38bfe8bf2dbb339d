"""`edge-replay`: what the runner's loops record gives the same outputs again, and whatever differs is found."""

from __future__ import annotations

import copy
import json
import math
import threading
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest

from edge.artifacts.manifest import Artifacts, load_artifacts
from edge.core.geometry import SE2
from edge.flightlog.reader import jpeg_bytes, read_messages
from edge.flightlog.recorder import Recorder
from edge.flightlog.replay.command import main
from edge.flightlog.schemas import SCHEMAS
from edge.flightlog.standard_schemas import STANDARD_SCHEMAS
from edge.inference.generation_task import GenerationModels
from edge.inference.language import LanguageModel
from edge.inference.policy import Policy
from edge.motion.controller import Controller, ControllerConfig
from edge.motion.recovery import BACKING_OFF, TURNING
from edge.reasoning.decoding_rules import EITHER_WAY, DecodingContext, TextConstraint, TurnDistances
from edge.reasoning.generation_cycle import Mode, ReasoningConfig
from edge.robot.camera import decode_frame
from edge.run.control_loop import CommandChain, ControlConfig, ControlLoop, ControlOutputs, ControlSources
from edge.run.reasoning_loop import ReasoningLoop, ReasoningOutputs, ReasoningSchedule
from edge.state.frame import Frame
from edge.state.pose_history import PoseHistory, StampedPose
from edge.state.reasoning_text import Progress
from edge.state.ring import TokenRing
from edge.state.semantic import SemanticSlot, SharedState
from firmware_bridge.core.config import LimitsConfig
from tests.edge.flightlog.test_log_schemas import complaints
from tests.support.runner import synthetic_run

TICK_NS = 100_000_000
TICKS = 60
GENERATION_TICKS = 15
DRIVEN = TICKS - GENERATION_TICKS
LIMITS = LimitsConfig(
    vx_min_mps=-0.4, vx_max_mps=0.8, vy_max_mps=0.3, wz_max_radps=1.0, accel_mps2=1.0, alpha_radps2=2.0
)
INSTRUCTION = "walk down the corridor"

Record = tuple[str, int, Any]


class Sink:
    """A bridge that accepts every command and sends no status."""

    def send_velocity(self, seq: int, stamp_ns: int, vx_mps: float, vy_mps: float, wz_radps: float) -> bool:
        return True

    def poll(self) -> None:
        return None


def drive(artifacts: Artifacts, recorder: Recorder, mode: Mode) -> None:
    """Record a run of the runner's two loops in one thread on a fake clock; a generation after every 15th tick."""
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
        INSTRUCTION,
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
        "instruction": INSTRUCTION,
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
        if tick % GENERATION_TICKS == GENERATION_TICKS - 1:
            assert reasoning.step()


@pytest.fixture(scope="module")
def driven(artifacts_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> list[Record]:
    path = tmp_path_factory.mktemp("driven") / "flight.mcap"
    recorder = Recorder(path)
    drive(load_artifacts(artifacts_dir), recorder, Mode.ASYNC)
    assert recorder.close()
    return [
        (topic, stamp_ns, jpeg_bytes(payload) if topic == "/camera" else payload)
        for topic, stamp_ns, payload in read_messages(path)
        if topic in SCHEMAS
    ]


class Log:
    """A run's records, to be changed, written and replayed."""

    def __init__(self, records: list[Record], path: Path, artifacts: Path) -> None:
        self.records = copy.deepcopy(records)
        self.path = path
        self.artifacts = artifacts

    def payload(self, topic: str, index: int) -> dict[str, Any]:
        """Record number `index` of a topic; changing it changes the log."""
        payload: dict[str, Any] = self.records[self.index(topic, index)][2]
        return payload

    def index(self, topic: str, number: int) -> int:
        """Place of record `number` of a topic in the log."""
        return [place for place, (found, *_) in enumerate(self.records) if found == topic][number]

    def drop_generation(self, number: int) -> None:
        del self.records[self.index("/semantic", number)]

    def drop(self, unwanted: Callable[[str, int, Any], bool]) -> None:
        self.records = [record for record in self.records if not unwanted(*record)]

    def write(self) -> None:
        recorder = Recorder(self.path)
        for record in self.records:
            recorder.put(*record)
        assert recorder.close() and recorder.dropped == {}

    def replay(self, *more: str) -> tuple[int, dict[str, Any]]:
        """Exit code and JSON result (empty if there is none)."""
        if not self.path.exists():
            self.write()
        out = self.path.with_suffix(".json")
        code = main([str(self.path), "--artifacts", str(self.artifacts), "--json", str(out), *more])
        return code, json.loads(out.read_text()) if out.exists() else {}


@pytest.fixture
def log(driven: list[Record], tmp_path: Path, artifacts_dir: Path) -> Log:
    return Log(driven, tmp_path / "flight.mcap", artifacts_dir)


@pytest.mark.parametrize("mode", [Mode.ASYNC, pytest.param(Mode.NO_REASONING, marks=pytest.mark.slow)])
def test_a_run_of_both_loops_is_replayed_bit_for_bit(artifacts_dir: Path, tmp_path: Path, mode: Mode) -> None:
    recorder = Recorder(tmp_path / "flight.mcap")
    drive(load_artifacts(artifacts_dir), recorder, mode)
    assert recorder.close() and recorder.dropped == {}
    for topic, _, payload in read_messages(tmp_path / "flight.mcap"):
        assert complaints(payload, {**SCHEMAS, **STANDARD_SCHEMAS}[topic]) == []
    code, result = Log([], tmp_path / "flight.mcap", artifacts_dir).replay()
    assert code == 0, result
    assert result["ticks"] == {
        "recorded": TICKS, **dict.fromkeys(("driven", "compared", "equal"), DRIVEN), "worst": None
    }  # fmt: skip
    assert result["generations"] == {
        "compared": 4, "texts_equal": 4, "different": [], "poses_interpolated": 0, "ways_from_frames": 0
    }  # fmt: skip
    assert result["commands"]["compared"] == TICKS
    assert result["trajectory_cm"]["max"] == result["heading_deg"]["max"] == result["command"]["max"] == 0
    assert result["skipped"] == {} and result["same_artifacts"] is True


def change_plan(log: Log) -> None:
    log.payload("/tick", 20)["trajectory"][1][0] += 0.01


def change_plan_to_no_number(log: Log) -> None:
    log.payload("/tick", 20)["trajectory"][1][2] = math.nan


def change_command(log: Log) -> None:
    log.payload("/tick", 35)["command"][0] += 0.02


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "where", "found"),
    [
        (change_plan, ("trajectory_cm", "max"), 1.0),
        (change_plan, ("ticks", "worst"), 20),
        (change_plan_to_no_number, ("heading_deg", "max"), 1e9),
        (change_command, ("command", "max"), 0.02),
        (lambda log: log.payload("/semantic", 1).update(text="another"), ("generations", "texts_equal"), 3),
        (lambda log: log.payload("/semantic", 1).update(instruction="turn around"), ("ticks", "compared"), DRIVEN),
    ],
    ids=["plan", "tick of the plan", "plan that is not finite", "command", "text", "instruction"],
)
def test_a_difference_beyond_the_tolerance_is_reported(
    log: Log, change: Callable[[Log], object], where: tuple[str, str], found: float
) -> None:
    change(log)
    code, result = log.replay()
    assert code == 1 and result["beyond"]
    assert result[where[0]][where[1]] == pytest.approx(found, abs=1e-4)


@pytest.mark.slow
def test_differences_within_the_tolerance_and_whole_turns_are_equal(log: Log) -> None:
    change_plan(log)
    log.payload("/tick", 21)["trajectory"][1][2] += 2 * math.pi
    assert log.replay("--tolerance-cm", "1.01")[0] == 0


@pytest.mark.slow
@pytest.mark.parametrize("reason", [BACKING_OFF, TURNING])
def test_a_command_that_was_not_the_plans_is_not_compared(log: Log, reason: str) -> None:
    log.payload("/tick", TICKS - 1).update(command=[0.0, 0.0, 0.5], reason=reason)
    assert log.replay()[0] == 0


@pytest.mark.slow
@pytest.mark.parametrize(
    "change", [{"way": [[-9.0, 3.0]]}, {"before": "last leg of 3, passed 0."}], ids=["path", "progress"]
)
def test_the_recorded_path_and_progress_are_in_the_prompt_again(log: Log, change: dict[str, Any]) -> None:
    log.payload("/semantic", 1).update(change)
    code, result = log.replay("--tolerance-cm", "0")
    assert code == 1 and result["ticks"]["equal"] < result["ticks"]["compared"]


@pytest.mark.slow
def test_a_generation_is_decoded_under_its_recorded_constraint(log: Log, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[DecodingContext] = []
    constraint = LanguageModel.constraint

    def watched(self: LanguageModel, context: DecodingContext) -> TextConstraint:
        asked.append(context)
        return constraint(self, context)

    monkeypatch.setattr(LanguageModel, "constraint", watched)
    fields = {"turn": "left", "turn_left_m": [2.5, 3.0], "turn_may_be_done": False, "keeps_form": True}
    log.payload("/semantic", 1).update(before="turn 1 of 3, passed 1.", follow=EITHER_WAY, **fields)
    for field in (*fields, "before", "follow"):
        log.payload("/semantic", 2).pop(field, None)
    log.replay()
    turn = TurnDistances("left", (2.5, 3.0))
    assert asked[1] == DecodingContext(Progress(1, 3, 1), EITHER_WAY, turn, turn_may_be_done=False, keeps_form=True)
    assert asked[2] == DecodingContext(None), "a log from before there were constraints"


@pytest.mark.slow
def test_records_missing_in_the_log_are_skipped_and_counted(log: Log) -> None:
    lost_ns = log.payload("/tick", 20)["frame_ns"]
    log.drop(lambda topic, stamp_ns, _: topic == "/camera" and stamp_ns == lost_ns)
    code, result = log.replay()
    assert (code, result["skipped"]) == (0, {"its picture is not in the log": 1}), "no reason to fail"
    log.path.unlink()
    log.drop_generation(2)
    _, result = log.replay()
    assert result["skipped"] == {
        "its picture is not in the log": 1, "its generation is not in the log": GENERATION_TICKS
    }  # fmt: skip
    assert result["ticks"]["compared"] == DRIVEN - 1 - GENERATION_TICKS


@pytest.mark.slow
def test_agreement_of_less_than_nine_plans_in_ten_is_none_unless_the_part_that_is_whole_is_named(log: Log) -> None:
    log.drop_generation(2)
    code, result = log.replay()
    assert (code, result["ticks"]["driven"]) == (1, DRIVEN)
    assert f"{DRIVEN - GENERATION_TICKS} of {DRIVEN} ticks with a plan" in result["beyond"][0]
    assert "its generation is not in the log" in result["beyond"][0]
    assert log.replay("--to", "4.4")[0] == 0


@pytest.mark.slow
def test_a_log_that_was_cut_is_replayed_as_far_as_it_is_whole(log: Log) -> None:
    log.records = log.records[: len(log.records) * 3 // 4]
    log.write()
    whole = log.path.read_bytes()
    log.path.write_bytes(whole[: len(whole) * 3 // 4])
    code, result = log.replay()
    assert code == 0 and 0 < result["ticks"]["recorded"] < TICKS


@pytest.mark.slow
def test_records_of_two_threads_may_lie_in_the_file_the_other_way_round(log: Log) -> None:
    log.records.append(log.records.pop(log.index("/semantic", 2)))
    code, result = log.replay()
    assert code == 0 and result["ticks"]["equal"] == DRIVEN


@pytest.mark.slow
def test_without_the_poses_of_frames_past_motion_comes_from_the_ticks(log: Log) -> None:
    for index in range(4):
        del log.payload("/semantic", index)["frame_poses"]
        del log.payload("/semantic", index)["way"]
    _, result = log.replay()
    assert result["generations"]["poses_interpolated"] == result["generations"]["ways_from_frames"] == 4


@pytest.mark.slow
def test_without_limits_commands_are_not_compared(log: Log) -> None:
    del log.payload("/run", 0)["limits"]
    code, result = log.replay()
    assert code == 0 and result["commands"]["compared"] == 0 and result["command"]["max"] is None


@pytest.mark.slow
def test_a_part_of_the_log_is_replayed_with_the_generation_that_it_drove_by(log: Log) -> None:
    code, result = log.replay("--from", "1.6", "--to", "2.0")
    assert code == 0
    assert result["ticks"]["compared"] == 5
    assert result["generations"]["compared"] == 1


@pytest.mark.slow
def test_nothing_to_compare_is_no_success(log: Log) -> None:
    code, result = log.replay("--from", "100")
    assert code == 1 and "no tick" in result["beyond"][0]


@pytest.mark.slow
def test_other_artifacts_are_refused_unless_forced(log: Log, capsys: pytest.CaptureFixture[str]) -> None:
    log.payload("/run", 0)["manifest_sha256"] = "0" * 64
    assert log.replay()[0] == 3
    assert "not the same artifacts" in capsys.readouterr().err
    code, result = log.replay("--force")
    assert code == 0 and result["same_artifacts"] is False
    assert "not the same artifacts" in capsys.readouterr().err


@pytest.mark.slow
def test_the_table_shows_the_same_as_the_json(log: Log, capsys: pytest.CaptureFixture[str]) -> None:
    log.write()
    assert main([str(log.path), "--artifacts", str(log.artifacts)]) == 0
    text = capsys.readouterr().out
    assert f"{DRIVEN} of {TICKS} run again, {DRIVEN} equal bit for bit" in text
    assert "4 run again, 4 texts equal" in text


@pytest.mark.slow
@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda log: log.drop(lambda topic, *_: topic == "/run"), "no /run record"),
        (lambda log: log.drop(lambda topic, *_: topic == "/tick"), "no /tick record"),
        (lambda log: log.payload("/tick", 20).pop("offset"), "a /tick record lacks"),
        (lambda log: log.payload("/tick", 20).update(state=[1]), "a /tick record lacks"),
        (lambda log: log.payload("/semantic", 0).update(frames_ns=[]), "a /semantic record lacks"),
        (lambda log: log.payload("/semantic", 0).update(way=[[1.0]]), "a /semantic record lacks"),
        (lambda log: log.payload("/semantic", 0).update(before="turn 9 of 3, passed 0."), "a /semantic record lacks"),
        (lambda log: log.payload("/semantic", 0).update(follow="backwards"), "a /semantic record lacks"),
        (lambda log: log.payload("/semantic", 0).update(turn="up", turn_left_m=[1.0]), "a /semantic record lacks"),
        (lambda log: log.payload("/semantic", 0).update(turn="left", turn_left_m=[]), "a /semantic record lacks"),
        (
            lambda log: log.payload("/semantic", 0).update(turn="left", turn_left_m=[math.inf]),
            "a /semantic record lacks",
        ),
        (lambda log: log.payload("/semantic", 0).update(turn="left", turn_left_m="35"), "a /semantic record lacks"),
        (lambda log: log.payload("/semantic", 0).update(turn_may_be_done="false"), "a /semantic record lacks"),
        (lambda log: log.payload("/run", 0).update(limits={"vx_max_mps": 1}), "a /run record lacks"),
        (lambda log: log.path.write_bytes(b"notes"), "not an MCAP file"),
    ],
)
def test_a_log_that_cannot_be_replayed_is_refused_in_one_line(
    log: Log, spoil: Callable[[Log], object], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    spoil(log)
    assert log.replay()[0] == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1 and message in lines[0] and "flight.mcap" in lines[0]


@pytest.mark.parametrize(
    "more", [("--from", "5", "--to", "4"), ("--tolerance-cm", "nan"), ("--json", ".")], ids=" ".join
)
def test_arguments_that_make_no_sense_are_refused(log: Log, more: tuple[str, ...]) -> None:
    log.write()
    assert main([str(log.path), "--artifacts", str(log.artifacts), *more]) == 2
