"""`edge-replay`: what the policy was given in a run gives the same again, and whatever differs is found."""

from __future__ import annotations

import copy
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from edge.artifacts.manifest import Artifacts, load_artifacts
from edge.core.geometry import SE2
from edge.flightlog.recorder import Recorder
from edge.flightlog.replay.command import main
from edge.inference.language import LanguageModel
from edge.inference.policy import Policy
from edge.motion.controller import Controller, ControllerConfig, ControllerInputs
from edge.motion.recovery import BACKING_OFF, TURNING
from edge.reasoning.decoding_rules import EITHER_WAY, DecodingContext, TextConstraint, TurnDistances
from edge.reasoning.path_memory import way_of
from edge.reasoning.prompt import format_before
from edge.run.camera import decode_frame
from edge.state.reasoning_text import Progress
from edge.state.ring import EncodedFrame
from edge.state.semantic import SemanticState
from firmware_bridge.core.config import LimitsConfig
from tests.support.runner import synthetic_run

START_NS = synthetic_run.START_NS
TICK_NS = 100_000_000
TICKS = 40
THINK_TICKS = 12
LIMITS = LimitsConfig(
    vx_min_mps=-0.4, vx_max_mps=0.8, vy_max_mps=0.3, wz_max_radps=1.0, accel_mps2=1.0, alpha_radps2=2.0
)
INSTRUCTION = "walk down the corridor"

Record = tuple[str, int, Any]


def pose_at(tick: float) -> SE2:
    return SE2(0.04 * tick, 0.01 * tick, 0.02 * math.sin(tick))


def drive(artifacts: Artifacts) -> list[Record]:
    """A short run without robot, clock or threads: what a runner would record that thinks for 12 ticks at a time."""
    policy, language = Policy(artifacts), LanguageModel(artifacts)
    controller = Controller(ControllerConfig(LIMITS, artifacts.runtime.step_s, 500, 200))
    frames: list[EncodedFrame] = []
    states: list[SemanticState] = []
    run = {
        "instruction": INSTRUCTION,
        "mode": "async",
        "artifacts": "nano",
        "manifest_sha256": artifacts.manifest_sha256,
        "robot": "go2",
        "limits": vars(LIMITS),
        "release_delay": {},
        "started_ns": START_NS,
        "tick_period_ms": 100,
    }
    records: list[Record] = [("/run", START_NS, run)]
    for tick in range(TICKS):
        start_ns = START_NS + tick * TICK_NS
        jpeg = synthetic_run.jpeg(tick / 10)
        tokens = policy.encode(decode_frame(jpeg, artifacts.runtime.image_px))
        frames.append(EncodedFrame(start_ns - 40_000_000, pose_at(tick - 0.4), tokens))
        records.append(("/camera", frames[-1].stamp_ns, jpeg))
        now_ns = start_ns + 20_000_000
        pose, speed = pose_at(tick + 0.2), (0.4, 0.0, 0.01)
        trajectory = offset = delay_s = semantic = None
        if states:
            semantic = states[-1]
            offset, delay_s = semantic.motion_offset(pose), semantic.delay_s(now_ns)
            trajectory = policy.act(tokens, speed, delay_s, offset, semantic)
        hold = "stale-frame" if tick == 30 else None
        scale = 0.5 if tick > 25 else 1.0
        inputs = ControllerInputs(trajectory, 60.0, 5.0, speed_scale=scale, hold=hold)
        command = controller.step(inputs, now_ns + 6_123_457)
        payload = {
            **synthetic_run.tick_records(0.1)[0],
            "tick": tick,
            "now_ns": now_ns,
            "start_ns": start_ns,
            "act_ms": 6.123457,
            "frame_ns": frames[-1].stamp_ns,
            "generation": semantic and semantic.generation,
            "anchor_ns": semantic and semantic.anchor_ns,
            "delay_s": delay_s,
            "offset": offset and offset.as_tuple(),
            "pose": pose.as_tuple(),
            "state": speed,
            "trajectory": None if trajectory is None else trajectory[9::10].tolist(),
            "command": (command.vx_mps, command.vy_mps, command.wz_radps),
            "reason": command.reason,
            "speed_scale": scale,
        }
        records.append(("/tick", start_ns, payload))
        if tick % THINK_TICKS == THINK_TICKS - 1:
            states.append(think(policy, language, frames[: tick - THINK_TICKS + 2], len(states)))
            records.append(semantic_record(states[-1], frames, start_ns + 50_000_000))
    return records


def think(policy: Policy, language: LanguageModel, frames: list[EncodedFrame], number: int) -> SemanticState:
    seen, before = frames[::-6][::-1], Progress(1, 3, number) if number else None
    way = way_of((frame.stamp_ns, frame.T_odom_base) for frame in frames)
    prompt = language.prompt.build(seen, INSTRUCTION, way, before)
    generation = language.generate(prompt, max_new_tokens=6 + number, cancelled=lambda: False)
    context = policy.semantic_context(generation.last_layer_kv)
    anchor, kv = seen[-1], generation.last_layer_kv
    TOLD[number] = {"way": way, "before": format_before(before)}
    THOUGHTS[number] = [frame.stamp_ns for frame in seen], generation.new_tokens
    return SemanticState(number, anchor.stamp_ns, anchor.T_odom_base, 0, kv, context, generation.text, None)


THOUGHTS: dict[int, tuple[list[int], int]] = {}
TOLD: dict[int, dict[str, Any]] = {}


def semantic_record(state: SemanticState, frames: list[EncodedFrame], ready_ns: int) -> Record:
    stamps, new_tokens = THOUGHTS[state.generation]
    poses = {frame.stamp_ns: frame.T_odom_base.as_tuple() for frame in frames}
    record = {
        **synthetic_run.generations(12)[0],
        "generation": state.generation,
        "anchor_ns": state.anchor_ns,
        "anchor_pose": state.T_odom_anchor.as_tuple(),
        "ready_ns": ready_ns,
        "frames_ns": stamps,
        "frame_poses": [poses[stamp_ns] for stamp_ns in stamps],
        **TOLD[state.generation],
        "max_new_tokens": 6 + state.generation,
        "new_tokens": new_tokens,
        "text": state.text,
    }
    return ("/semantic", ready_ns, record)


@pytest.fixture(scope="module")
def driven(artifacts_dir: Path) -> list[Record]:
    return drive(load_artifacts(artifacts_dir))


class Log:
    """A run's records, to be changed, written and replayed."""

    def __init__(self, records: list[Record], path: Path, artifacts: Path) -> None:
        self.records = copy.deepcopy(records)
        self.path = path
        self.artifacts = artifacts

    def payload(self, topic: str, index: int) -> dict[str, Any]:
        """Record number `index` of a topic; changing it changes the log."""
        return [payload for found, _, payload in self.records if found == topic][index]

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


def test_the_same_artifacts_give_the_same_plans_texts_and_commands(log: Log) -> None:
    code, result = log.replay()
    assert code == 0, result
    driven_ticks = TICKS - THINK_TICKS
    assert result["ticks"] == {
        "recorded": TICKS,
        **dict.fromkeys(("driven", "compared", "equal"), driven_ticks),
        "worst": None,
    }
    assert result["generations"]["compared"] == result["generations"]["texts_equal"] == 3
    assert result["commands"]["compared"] == TICKS
    assert result["trajectory_cm"]["max"] == result["heading_deg"]["max"] == result["command"]["max"] == 0
    assert result["skipped"] == {} and result["same_artifacts"] is True


@pytest.mark.slow
def test_a_plan_that_differs_is_beyond_the_tolerance_and_named(log: Log) -> None:
    log.payload("/tick", 20)["trajectory"][1][0] += 0.01
    code, result = log.replay()
    assert code == 1
    assert result["ticks"]["worst"] == 20
    assert result["trajectory_cm"]["max"] == pytest.approx(1.0)
    assert "plan up to 1 cm apart" in result["beyond"][0]
    assert log.replay("--tolerance-cm", "1.01")[0] == 0


@pytest.mark.slow
def test_a_heading_a_whole_turn_away_is_the_same(log: Log) -> None:
    log.payload("/tick", 20)["trajectory"][1][2] += 2 * math.pi
    assert log.replay()[0] == 0


@pytest.mark.slow
def test_a_plan_that_was_not_finite_in_the_run_is_infinitely_far_away(log: Log) -> None:
    log.payload("/tick", 20)["trajectory"][1][2] = math.nan
    code, result = log.replay()
    assert code == 1 and result["heading_deg"]["max"] == 1e9


@pytest.mark.slow
def test_another_command_than_the_controller_gives_is_found(log: Log) -> None:
    vx, vy, wz = log.payload("/tick", 35)["command"]
    log.payload("/tick", 35)["command"] = [vx + 0.02, vy, wz]
    code, result = log.replay()
    assert code == 1 and result["command"]["max"] == pytest.approx(0.02, abs=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("reason", [BACKING_OFF, TURNING])
def test_a_command_that_was_not_the_plans_is_not_compared(log: Log, reason: str) -> None:
    log.payload("/tick", TICKS - 1).update(command=[0.0, 0.0, 0.5], reason=reason)
    code, _ = log.replay()
    assert code == 0


@pytest.mark.slow
def test_another_text_is_found(log: Log) -> None:
    log.payload("/semantic", 1)["text"] += "!"
    code, result = log.replay()
    assert code == 1 and result["generations"]["different"] == [1]


@pytest.mark.slow
def test_another_instruction_is_another_prompt(log: Log) -> None:
    log.payload("/run", 0)["instruction"] = "turn around"
    assert log.replay()[0] == 1


@pytest.mark.slow
@pytest.mark.parametrize(
    "told", [{"way": [[-9.0, 3.0]]}, {"before": "last leg of 3, passed 0."}], ids=["way", "before"]
)
def test_what_the_prompt_told_of_the_way_and_progress_is_told_again(log: Log, told: dict[str, Any]) -> None:
    log.payload("/semantic", 1).update(told)
    code, result = log.replay("--tolerance-cm", "0")
    assert code == 1 and result["ticks"]["equal"] < result["ticks"]["compared"]


@pytest.mark.slow
def test_a_generation_is_held_to_what_it_was_held_to(log: Log, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[DecodingContext] = []
    constraint = LanguageModel.constraint

    def watched(self: LanguageModel, known: DecodingContext) -> TextConstraint:
        asked.append(known)
        return constraint(self, known)

    monkeypatch.setattr(LanguageModel, "constraint", watched)
    log.payload("/semantic", 1).update(follow=EITHER_WAY, turn="left", turn_left_m=[2.5, 3.0], turn_may_be_done=False)
    assert log.replay()[0] == 0
    turn = TurnDistances("left", (2.5, 3.0))
    assert asked[1] == DecodingContext(Progress(1, 3, 1), EITHER_WAY, turn, turn_may_be_done=False)
    # A log from before generations were held to anything says nothing of it.
    assert asked[2] == DecodingContext(Progress(1, 3, 2))


@pytest.mark.slow
def test_what_the_log_lost_is_skipped_and_counted(log: Log) -> None:
    lost_ns = log.payload("/tick", 20)["frame_ns"]
    log.drop(lambda topic, stamp_ns, _: topic == "/camera" and stamp_ns == lost_ns)
    log.drop(lambda topic, _, payload: topic == "/semantic" and payload["generation"] == 2)
    _, result = log.replay()
    assert result["skipped"] == {"its picture is not in the log": 1, "its generation is not in the log": 4}
    assert result["ticks"]["compared"] == TICKS - THINK_TICKS - 5


@pytest.mark.slow
def test_a_lost_picture_is_no_reason_to_fail(log: Log) -> None:
    lost_ns = log.payload("/tick", 20)["frame_ns"]
    log.drop(lambda topic, stamp_ns, _: topic == "/camera" and stamp_ns == lost_ns)
    code, result = log.replay()
    assert (code, result["skipped"]) == (0, {"its picture is not in the log": 1})


@pytest.mark.slow
def test_agreement_of_less_than_nine_plans_in_ten_is_none_unless_the_part_that_is_whole_is_named(log: Log) -> None:
    log.drop(lambda topic, _, payload: topic == "/semantic" and payload["generation"] == 2)
    code, result = log.replay()
    driven = TICKS - THINK_TICKS
    assert (code, result["ticks"]["driven"]) == (1, driven)
    assert f"{driven - 4} of {driven} ticks with a plan" in result["beyond"][0]
    assert "its generation is not in the log" in result["beyond"][0]
    assert log.replay("--to", "3.5")[0] == 0


@pytest.mark.slow
def test_a_log_that_was_cut_is_replayed_as_far_as_it_is_whole(log: Log) -> None:
    log.records = log.records[:70]
    log.write()
    whole = log.path.read_bytes()
    log.path.write_bytes(whole[: len(whole) * 3 // 4])
    code, result = log.replay()
    assert code == 0 and 0 < result["ticks"]["recorded"] < TICKS


@pytest.mark.slow
def test_records_of_two_threads_may_lie_in_the_file_the_other_way_round(log: Log) -> None:
    log.records.sort(key=lambda record: record[0] == "/semantic")
    code, result = log.replay()
    assert code == 0 and result["ticks"]["equal"] == TICKS - THINK_TICKS


@pytest.mark.slow
def test_without_the_frames_poses_past_motion_is_told_from_the_ticks(log: Log) -> None:
    for index in range(3):
        del log.payload("/semantic", index)["frame_poses"]
        del log.payload("/semantic", index)["way"]
    _, result = log.replay()
    assert result["generations"]["poses_interpolated"] == result["generations"]["ways_from_frames"] == 3


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
def test_the_table_says_the_same_as_the_json(log: Log, capsys: pytest.CaptureFixture[str]) -> None:
    log.write()
    assert main([str(log.path), "--artifacts", str(log.artifacts)]) == 0
    said = capsys.readouterr().out
    assert f"{TICKS - THINK_TICKS} of {TICKS} run again, {TICKS - THINK_TICKS} equal bit for bit" in said
    assert "3 run again, 3 texts equal" in said


@pytest.mark.parametrize(
    ("spoil", "said"),
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
    log: Log, spoil: Callable[[Log], object], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    spoil(log)
    assert log.replay()[0] == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1 and said in lines[0] and "flight.mcap" in lines[0]


@pytest.mark.parametrize(
    "more", [("--from", "5", "--to", "4"), ("--tolerance-cm", "nan"), ("--json", ".")], ids=" ".join
)
def test_arguments_that_make_no_sense_are_refused(log: Log, more: tuple[str, ...]) -> None:
    log.write()
    assert main([str(log.path), "--artifacts", str(log.artifacts), *more]) == 2
