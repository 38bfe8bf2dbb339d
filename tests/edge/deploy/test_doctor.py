"""`edge-doctor`: where every node ran, what a tick takes, whether bridge and robot answer; its exit codes and JSON."""

from __future__ import annotations

import argparse
import dataclasses
import json
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from edge.artifacts.files import ArtifactError, seal
from edge.artifacts.manifest import Artifacts, load_artifacts
from edge.artifacts.target_facts import GIB, PlanFacts, plan_facts, target_facts
from edge.core.cli import EXIT_BAD_INPUT, EXIT_CHECK_FAILED, EXIT_DONE
from edge.core.device import CUDA, OPENVINO
from edge.deploy.doctor.check import Check, Level
from edge.deploy.doctor.command import examine, main, parser
from edge.deploy.doctor.graphs import Placement, guarded, judge_placement, judge_ticks, placements, profile_graph
from edge.deploy.doctor.robot import bridge, robot_link
from edge.inference.graph import CPU_PROVIDER
from edge.inference.start_guard import StartGuard
from edge.robot.reader import RobotCamera
from export.targets.file import load_target
from firmware_bridge.core.config import RobotConfig, load_robot_config
from firmware_bridge.core.link import BridgeStatus
from firmware_bridge.core.robot_state import CameraError, DdsError
from tests.edge.inference.test_self_test import loop_for_ever
from tests.support.processes import GO2_SIM

PLAN = PlanFacts(100.0, 60.0, 40.0, 0.2, 1100, 4 * GIB, "modelled")


def event(name: str, provider: str, operator: str, size: int = 4096, duration_us: int = 10) -> dict[str, Any]:
    args = {"provider": provider, "op_name": operator, "output_size": str(size)}
    return {"cat": "Node", "name": f"{name}_kernel_time", "dur": duration_us, "args": args}


def test_a_profile_names_the_provider_of_every_node() -> None:
    events = [
        {"cat": "Session", "name": "session_initialization"},
        event("a", CUDA, "MatMul", duration_us=5),
        event("a", CUDA, "MatMul", duration_us=7),
        event("b", CPU_PROVIDER, "Shape", size=16),
    ]
    assert placements(events) == [Placement(CPU_PROVIDER, "Shape", 1, 16, 10), Placement(CUDA, "MatMul", 1, 4096, 12)]


@pytest.mark.parametrize("events", [[], [{"cat": "Node", "name": "a_kernel_time", "args": {}}], ["text"]])
def test_an_incomplete_profile_is_refused(events: Sequence[Any]) -> None:
    with pytest.raises(ValueError, match="node"):
        placements(events)


@pytest.mark.parametrize(
    ("places", "level", "found"),
    [
        ([], Level.OK, ""),
        (
            [Placement(CPU_PROVIDER, "LayerNormalization", 1, 1 << 20, 1500)],
            Level.FAIL,
            "1 LayerNormalization on CPUExecutionProvider take 1.50 ms",
        ),
        ([Placement(CPU_PROVIDER, "Gather", 3, 32, 5)], Level.OK, ""),
        ([Placement(CPU_PROVIDER, "MemcpyToHost", 2, 1 << 20, 50)], Level.OK, ""),
        ([Placement(CPU_PROVIDER, "Gather", 1, 1 << 20, 900)], Level.FAIL, ""),
        ([Placement("OpenVINOExecutionProvider", "Shape", 1, 8, 1)], Level.FAIL, ""),
    ],
    ids=["all on CUDA", "fell back", "shapes", "copies", "the same operator on real data", "a third provider"],
)
def test_only_nodes_that_compute_shapes_may_run_on_the_processor(
    places: list[Placement], level: Level, found: str
) -> None:
    on_cuda = Placement(CUDA, "MatMul", 100, 1 << 20, 5000)
    check = judge_placement("vision_encoder", CUDA, [on_cuda, *places])
    assert check.level is level and found in check.found


def test_every_graph_of_real_artifacts_runs_on_its_manifests_provider(artifacts: Artifacts) -> None:
    checks = [profile_graph(artifacts, name, guarded(artifacts)) for name in artifacts.graphs]
    assert [check.level for check in checks] == [Level.OK] * len(artifacts.graphs), checks


@pytest.mark.filterwarnings("ignore:Specified provider")
def test_a_graph_that_onnx_runtime_quietly_runs_on_the_processor_instead_fails(artifacts: Artifacts) -> None:
    graph = artifacts.graphs["action_expert"]
    moved = dataclasses.replace(graph, session=dataclasses.replace(graph.session, provider=CUDA))
    check = profile_graph(
        dataclasses.replace(artifacts, graphs={**artifacts.graphs, "action_expert": moved}),
        "action_expert",
        guarded(artifacts),
    )
    assert check.level is Level.FAIL
    assert "nodes on CPUExecutionProvider" in check.found


def test_a_graph_that_loops_does_not_hang_the_profile(artifacts_dir: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(artifacts_dir, tmp_path / "nano"))
    loop_for_ever(copy)

    class Impatient(StartGuard):
        @contextmanager
        def stage(self, what: str, limit_s: float) -> Iterator[None]:
            with super().stage(what, min(limit_s, 0.5)):
                yield

    looping = load_artifacts(copy)
    check = profile_graph(looping, "action_expert", Impatient(looping, end=lambda _line: None))
    assert check.level is Level.FAIL and "profile of action_expert: not done after its limit" in check.found


def test_a_graph_is_profiled_with_the_options_that_the_runner_gives_to_its_provider(
    artifacts: Artifacts, monkeypatch: pytest.MonkeyPatch
) -> None:
    graph = artifacts.graphs["vision_encoder"]
    session = dataclasses.replace(graph.session, provider=OPENVINO, options={"inference_precision": "bf16"}, threads=3)
    moved = {**artifacts.graphs, "vision_encoder": dataclasses.replace(graph, session=session)}
    opened: list[tuple[Any, Any]] = []

    def refuse(_content: bytes, options: Any, providers: Any) -> None:
        opened.append((options, providers))
        raise RuntimeError("no such library")

    monkeypatch.setattr("onnxruntime.InferenceSession", refuse)
    check = profile_graph(dataclasses.replace(artifacts, graphs=moved), "vision_encoder", guarded(artifacts))
    assert check.level is Level.FAIL and "no such library" in check.found
    ((options, providers),) = opened
    hint = '{"CPU": {"INFERENCE_PRECISION_HINT": "bf16"}}'
    assert providers == [(OPENVINO, {"num_of_threads": "3", "load_config": hint})]
    assert options.get_session_config_entry("session.disable_cpu_ep_fallback") == "1"
    assert options.enable_profiling


@pytest.mark.parametrize(
    ("times_ms", "plan", "level"),
    [
        ([40.0] * 50, PLAN, Level.OK),
        ([59.0] * 50, PLAN, Level.OK),
        ([61.0] * 50, PLAN, Level.WARN),
        ([40.0] * 9 + [150.0], PLAN, Level.FAIL),
        ([99.0] * 10, None, Level.OK),
        ([], None, Level.SKIP),
    ],
)
def test_ticks_are_compared_with_the_plan_and_the_period(
    times_ms: list[float], plan: PlanFacts | None, level: Level
) -> None:
    assert judge_ticks(times_ms, plan, 100).level is level


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> RobotConfig:
    return load_robot_config(GO2_SIM, socket=tmp_path_factory.mktemp("run") / "bridge.sock")


@pytest.mark.parametrize(
    ("state", "blocked_by", "level", "text"),
    [
        ("disarmed", "none", Level.OK, ""),
        ("stopped", "estop", Level.FAIL, "`edge-bridge arm` while a runner waits"),
        ("disarmed", "operator", Level.OK, "waits for `edge-bridge arm`"),
    ],
)
def test_a_bridge_that_would_refuse_to_arm_fails_with_its_reason(
    robot: RobotConfig, state: str, blocked_by: str, level: Level, text: str
) -> None:
    status = BridgeStatus(1, state, "why", 0, 0, 0, (0.0, 0.0, 0.0), True, "none", blocked_by)
    check = bridge(robot, lambda _robot: status)
    assert check.level is level and text in check.found + check.advice


def test_a_bridge_that_is_not_there_fails_in_one_line(robot: RobotConfig) -> None:
    check = bridge(robot)
    assert check.level is Level.FAIL and "\n" not in check.found


def jpeg(value: int | None) -> bytes:
    picture = np.random.default_rng(0).integers(0, 255, (48, 64, 3), dtype=np.uint8)
    ok, data = cv2.imencode(".jpg", picture if value is None else np.full_like(picture, value))
    assert ok
    return bytes(data)


class FakeRobot:
    """What `Go2Reader` gives, without a bus."""

    def __init__(self, frame: bytes | Exception, *, silent: bool = False, surplus: str | None = None) -> None:
        self._frame, self._silent, self._surplus = frame, silent, surplus
        self.closed = False

    def state(self) -> Any:
        return None if self._silent else argparse.Namespace(mode=1, error_code=0)

    def request_frame(self, timeout_s: float) -> bytes:
        if isinstance(self._frame, Exception):
            raise self._frame
        return self._frame

    def surplus_publishers(self) -> str | None:
        return self._surplus

    def close(self) -> None:
        self.closed = True


def checked(robot: RobotConfig, fake: FakeRobot) -> list[Check]:
    checks = robot_link(robot, 224, opener=lambda _robot: (fake, RobotCamera(fake.request_frame)), timeout_s=0.0)
    assert fake.closed
    return checks


@pytest.mark.parametrize(
    ("fake", "levels"),
    [
        (FakeRobot(jpeg(None)), [Level.OK, Level.OK]),
        (FakeRobot(jpeg(None), silent=True), [Level.FAIL, Level.SKIP]),
        (FakeRobot(CameraError("camera: no answer")), [Level.OK, Level.FAIL]),
        (FakeRobot(b"\xff\xd8 no picture"), [Level.OK, Level.FAIL]),
        (FakeRobot(b""), [Level.OK, Level.FAIL]),
        (FakeRobot(jpeg(0)), [Level.OK, Level.FAIL]),
    ],
    ids=["fine", "silent", "no picture", "torn", "empty", "black"],
)
def test_a_robot_must_report_its_state_and_give_a_picture(
    robot: RobotConfig, fake: FakeRobot, levels: list[Level]
) -> None:
    assert [check.level for check in checked(robot, fake)] == levels


def test_a_second_robot_on_the_network_fails_and_is_named(robot: RobotConfig) -> None:
    check = checked(robot, FakeRobot(jpeg(None), surplus="2 publishers of rt/sportmodestate, expected 1"))[0]
    assert (check.level, "2 publishers of rt/sportmodestate" in check.found) == (Level.FAIL, True)
    assert "two robots" in check.advice


def test_a_bus_that_cannot_be_joined_fails(robot: RobotConfig) -> None:
    def refuse(_robot: RobotConfig) -> Any:
        raise DdsError("DDS: cannot join domain 0 on interface 'eth0'")

    assert [check.level for check in robot_link(robot, 224, opener=refuse)] == [Level.FAIL, Level.SKIP]


def run(tmp_path: Path, *words: str) -> tuple[int, dict[str, Any]]:
    result = tmp_path / "doctor.json"
    code = main([*words, "--json", str(result)])
    return code, json.loads(result.read_text())


def by_name(result: dict[str, Any]) -> dict[str, dict[str, str]]:
    return {check["name"]: check for check in result["checks"]}


@pytest.mark.slow
def test_real_artifacts_on_the_machine_that_they_are_for(artifacts_dir: Path, tmp_path: Path) -> None:
    code, result = run(
        tmp_path, "--artifacts", str(artifacts_dir), "--target", "cpu", "--ticks", "3", "--logs", str(tmp_path)
    )
    checks = by_name(result)
    assert checks["target"]["level"] == checks["provider of vision_encoder"]["level"] == "ok"
    assert "ms of 3 ticks" in checks["tick"]["found"]
    assert code == (EXIT_DONE if result["ok"] else EXIT_CHECK_FAILED)
    assert sum(result["counts"].values()) == len(result["checks"])


def test_a_missing_option_is_shown_as_skipped(tmp_path: Path) -> None:
    _, result = run(tmp_path, "--logs", str(tmp_path))
    checks = by_name(result)
    for name in ("artifacts", "target", "tick", "robot file"):
        assert checks[name]["level"] == "skip"
        assert checks[name]["found"].startswith("skipped: ")


@pytest.mark.slow
def test_artifacts_of_another_target_fail(artifacts_dir: Path, tmp_path: Path) -> None:
    code, result = run(tmp_path, "--artifacts", str(artifacts_dir), "--target", "orin", "--ticks", "0")
    assert (code, by_name(result)["artifacts"]["level"]) == (EXIT_CHECK_FAILED, "fail")


def test_a_file_that_cannot_be_opened_fails_and_the_rest_is_still_checked(tmp_path: Path) -> None:
    code, result = run(tmp_path, "--artifacts", str(tmp_path / "none"), "--robot", str(tmp_path / "none.toml"))
    checks = by_name(result)
    assert code == EXIT_CHECK_FAILED
    assert checks["artifacts"]["level"] == checks["robot file"]["level"] == "fail"
    assert "clock" in checks


@pytest.mark.slow
def test_a_manifest_that_is_wrong_about_its_device_is_a_failure_among_others(
    artifacts_dir: Path, tmp_path: Path
) -> None:
    copy = Path(shutil.copytree(artifacts_dir, tmp_path / "nano"))
    manifest = json.loads((copy / "manifest.json").read_text())
    manifest["provenance"]["target"]["device"]["cores"] = "two"
    manifest["plan"]["tick_ms"] = -1
    (copy / "manifest.json").write_text(json.dumps(seal(manifest)))
    code, result = run(tmp_path, "--artifacts", str(copy), "--ticks", "0", "--logs", str(tmp_path))
    checks = by_name(result)
    assert code == EXIT_CHECK_FAILED
    assert checks["target in the manifest"]["level"] == checks["plan in the manifest"]["level"] == "fail"
    assert "clock" in checks


def test_a_graphics_cards_memory_is_told_apart_from_the_machines() -> None:
    for name, own in (("cpu", False), ("orin", False), ("rtx4060", True)):
        facts = target_facts({"provenance": {"target": load_target(name).to_dict()}})
        assert facts is not None
        assert facts.own_memory is own


@pytest.mark.slow
def test_missing_engines_fail_with_the_command_that_builds_them(artifacts_dir: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(artifacts_dir, tmp_path / "orin"))
    manifest = json.loads((copy / "manifest.json").read_text())
    target = load_target("orin", "nano")
    for name in ("vision_encoder", "semantic_context", "action_expert"):
        entry = manifest["graphs"][name]
        entry["session"] = target.session(name, entry["inputs"])
    (copy / "manifest.json").write_text(json.dumps(seal(manifest)))
    args = parser().parse_args(["--artifacts", str(copy)])
    checks = {check.name: check for check in examine(args)}
    assert checks["engines"].level is Level.FAIL
    assert checks["engines"].advice.startswith("edge-install engines")
    assert checks["tick"].level is Level.SKIP


def test_bad_arguments_are_bad_input(tmp_path: Path) -> None:
    assert main(["--ticks", "-1"]) == EXIT_BAD_INPUT
    assert main(["--json", str(tmp_path)]) == EXIT_BAD_INPUT


def test_with_a_dash_standard_output_is_the_json_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    main(["--logs", str(tmp_path), "--json", "-"])
    output = capsys.readouterr()
    assert json.loads(output.out)["checks"]
    assert "clock" in output.err


@pytest.mark.parametrize("memory_gib", [1e308, 10**400])
def test_a_memory_that_rounds_to_infinity_is_refused(memory_gib: float) -> None:
    target = load_target("cpu").to_dict()
    target["device"]["memory_gib"] = memory_gib
    with pytest.raises(ArtifactError, match=r"memory_gib must be a number up to 2\^53"):
        target_facts({"provenance": {"target": target}})


@pytest.mark.parametrize(
    "change",
    [
        {"plan": []},
        {"plan": {"period_ms": "100"}},
        {"provenance": {"target": 7}},
        {"provenance": {"target": {"device": {}}}},
        {"provenance": None},
    ],
)
def test_a_manifest_that_is_wrong_about_its_device_is_refused(change: dict[str, Any]) -> None:
    manifest = {"plan": {}, "provenance": {}, **change}
    with pytest.raises(ArtifactError):
        target_facts(manifest)
        plan_facts(manifest)
