"""Engines are built ahead of time, on the device, once; what is not this device's own is refused before control."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from edge.artifacts.files import seal
from edge.artifacts.manifest import Artifacts, load_artifacts
from edge.core.cli import EXIT_BAD_INPUT, EXIT_DONE, EXIT_REFUSED
from edge.core.device import (
    OPENVINO,
    TENSORRT,
    DeviceError,
    DeviceFacts,
    check_power_mode,
    current_power_mode,
    l4t_release,
    power_modes,
    read_device,
)
from edge.deploy.install import main
from edge.inference.engines import (
    ENGINES_NAME,
    EngineError,
    Machine,
    build,
    check,
    default_directory,
    needed,
    with_engines,
)
from edge.inference.graph import GraphError
from export.targets.file import load_target

NEEDING = ("vision_encoder", "semantic_context", "action_expert")
FACTS = DeviceFacts("aarch64", "nvidia,p3767-0000", "36.4.3", "1.25.1", "10.3.0")
CONF = """
< POWER_MODEL ID=0 NAME=MAXN_SUPER >
CPU_ONLINE CORE_0 1
< POWER_MODEL ID=3 NAME=25W >
GPU MAX_FREQ 408000000
< POWER_MODEL ID=4 NAME=40W >
"""


@dataclass
class FakeTensorRt:
    """A provider that compiles into its cache folder unless the engine is there, as TensorRT's does."""

    facts: DeviceFacts = FACTS
    providers: list[str] = field(default_factory=lambda: [TENSORRT, "CPUExecutionProvider"])
    compiled: list[str] = field(default_factory=list)
    shapes: list[tuple[str, tuple[int, ...]]] = field(default_factory=list)
    ignores_cache: bool = False
    same_bytes: bool = False
    takes_nothing: bool = False
    fails_on: str | None = None
    interrupted_on: str | None = None

    def machine(self) -> Machine:
        return Machine(lambda _provider: self.facts, lambda: self.providers, self.open, lambda: 0)

    def open(self, artifacts: Artifacts, name: str) -> Any:
        if name == self.interrupted_on:
            raise KeyboardInterrupt
        options = artifacts.graphs[name].session.options
        engine = Path(options["trt_engine_cache_path"]) / f"TensorrtExecutionProvider_{name}_sm87.engine"
        if not self.takes_nothing and (self.ignores_cache or not engine.exists()):
            self.compiled.append(name)
            engine.write_bytes(f"engine of {name}, {0 if self.same_bytes else len(self.compiled)}".encode())
            (engine.parent / "sm87.timing").write_text(str(len(self.compiled)))
        return _Session(self, name)


@dataclass
class _Session:
    provider: FakeTensorRt
    name: str

    def run(self, feeds: Mapping[str, np.ndarray], outputs: Any = None) -> list[np.ndarray]:
        if self.name == self.provider.fails_on:
            raise GraphError("out of memory")
        self.provider.shapes += [(name, array.shape) for name, array in feeds.items()]
        return []


def edit(directory: Path, change: Callable[[dict[str, Any]], None]) -> None:
    path = directory / "manifest.json"
    manifest = json.loads(path.read_text())
    change(manifest)
    path.write_text(json.dumps(seal(manifest)))


def for_orin(manifest: dict[str, Any]) -> None:
    target = load_target("orin", "nano")
    for name in NEEDING:
        entry = manifest["graphs"][name]
        entry["session"] = target.session(name, entry["inputs"])


@pytest.fixture
def directory(artifacts_dir: Path, tmp_path: Path) -> Path:
    copy = Path(shutil.copytree(artifacts_dir, tmp_path / "orin"))
    edit(copy, for_orin)
    return copy


@pytest.fixture
def orin(directory: Path) -> Artifacts:
    return load_artifacts(directory)


@pytest.fixture
def engines(tmp_path: Path) -> Path:
    return tmp_path / "engines"


def silent(_line: str) -> None:
    pass


def test_only_graphs_of_a_provider_that_compiles_need_an_engine(orin: Artifacts, artifacts: Artifacts) -> None:
    assert set(needed(orin)) == set(NEEDING)
    assert needed(artifacts) == []


def engine_file(engines: Path) -> Path:
    return next((engines / "vision_encoder").glob("*.engine"))


def test_an_engine_that_stays_is_accepted_after_it_was_opened(orin: Artifacts, engines: Path) -> None:
    fake = FakeTensorRt()
    build(orin, engines, silent, fake.machine())
    check(orin, engines, fake.machine()).check_unchanged()


def test_an_engine_rewritten_after_its_hash_was_checked_with_its_time_restored_is_refused(
    orin: Artifacts, engines: Path
) -> None:
    fake = FakeTensorRt()
    build(orin, engines, silent, fake.machine())
    verified, path = check(orin, engines, fake.machine()), engine_file(engines)
    before = path.stat()
    path.write_bytes(bytes(before.st_size))
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))
    with pytest.raises(EngineError, match=r"\.engine: changed while"):
        verified.check_unchanged()


def test_an_engine_swapped_by_renames_while_it_was_opened_is_refused_although_the_first_is_back(
    orin: Artifacts, engines: Path, tmp_path: Path
) -> None:
    fake = FakeTensorRt()
    build(orin, engines, silent, fake.machine())
    verified, path = check(orin, engines, fake.machine()), engine_file(engines)
    aside = path.rename(tmp_path / "aside")
    path.write_bytes(b"another engine")
    aside.replace(path)
    with pytest.raises(EngineError, match=r"\.engine: changed while"):
        verified.check_unchanged()


def test_nothing_is_asked_of_artifacts_without_engines(artifacts: Artifacts, engines: Path) -> None:
    check(artifacts, engines).check_unchanged()
    assert build(artifacts, engines, silent) == {}


def test_what_was_built_is_accepted(orin: Artifacts, engines: Path) -> None:
    fake = FakeTensorRt()
    results = build(orin, engines, silent, fake.machine())
    check(orin, engines, fake.machine())
    assert set(results) == set(NEEDING)
    assert all(result["built"] for result in results.values())


def test_the_runner_finds_what_was_built_and_compiles_nothing(orin: Artifacts, engines: Path) -> None:
    fake = FakeTensorRt()
    build(orin, engines, silent, fake.machine())
    ready, compiled = with_engines(orin, engines), list(fake.compiled)
    for name in NEEDING:
        fake.open(ready, name)
    assert fake.compiled == compiled == list(needed(orin))


def test_every_shape_of_the_profiles_is_run_at_build_time(orin: Artifacts, engines: Path) -> None:
    fake = FakeTensorRt()
    build(orin, engines, silent, fake.machine())
    lengths = {shape[1] for name, shape in fake.shapes if name == "last_layer_kv"}
    assert lengths == {1, 240, 512}
    fixed = {shape for name, shape in fake.shapes if name == "frame"}
    assert fixed == {(1, 128, 128, 3)}


def test_a_profile_shorter_than_the_models_context_is_refused(directory: Path, engines: Path) -> None:
    edit(directory, lambda m: m["runtime"].update(max_context=513))
    for refused in (check, lambda *given: build(given[0], given[1], silent, given[2])):
        with pytest.raises(
            EngineError, match=r"semantic_context: .* of at most 512 tokens, the model reads 513; export"
        ):
            refused(load_artifacts(directory), engines, FakeTensorRt().machine())
    assert not engines.exists()


def test_a_second_build_builds_nothing(orin: Artifacts, engines: Path) -> None:
    fake = FakeTensorRt()
    first = build(orin, engines, silent, fake.machine())
    fake.compiled.clear()
    second = build(orin, engines, silent, fake.machine())
    assert fake.compiled == []
    assert {name: r["key"] for name, r in second.items()} == {name: r["key"] for name, r in first.items()}
    assert not any(result["built"] for result in second.values())


def test_an_interrupted_build_goes_on_where_it_stopped(orin: Artifacts, engines: Path) -> None:
    fake = FakeTensorRt(interrupted_on="action_expert")
    with pytest.raises(KeyboardInterrupt):
        build(orin, engines, silent, fake.machine())
    assert not list(engines.glob("*.partial"))
    with pytest.raises(EngineError, match="action_expert: has no engine"):
        check(orin, engines, fake.machine())
    again = FakeTensorRt()
    build(orin, engines, silent, again.machine())
    assert again.compiled == ["action_expert"]


def test_a_missing_engine_is_refused_with_the_command_that_builds_it(orin: Artifacts, engines: Path) -> None:
    with pytest.raises(EngineError) as refusal:
        check(orin, engines, FakeTensorRt().machine())
    line = str(refusal.value)
    assert f"edge-install engines --artifacts {orin.directory} --engines {engines}" in line
    assert "\n" not in line


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"onnxruntime": "1.26.0"}, "onnxruntime 1.25.1 → 1.26.0"),
        ({"provider_version": "10.7.0"}, "provider_version 10.3.0 → 10.7.0"),
        ({"device": "nvidia,p3767-0001"}, "device nvidia,p3767-0000 → nvidia,p3767-0001"),
        ({"l4t": "36.5.0"}, "l4t 36.4.3 → 36.5.0"),
    ],
)
def test_an_engine_of_another_device_or_release_is_refused_by_what_differs(
    orin: Artifacts, engines: Path, change: dict[str, str], named: str
) -> None:
    fake = FakeTensorRt()
    build(orin, engines, silent, fake.machine())
    fake.facts = replace(FACTS, **change)
    with pytest.raises(EngineError, match="was built for something else") as refusal:
        check(orin, engines, fake.machine())
    assert named in str(refusal.value)


def test_other_options_need_another_engine(directory: Path, orin: Artifacts, engines: Path) -> None:
    fake = FakeTensorRt()
    build(orin, engines, silent, fake.machine())
    edit(directory, lambda m: m["graphs"]["vision_encoder"]["session"]["options"].update(trt_fp16_enable="0"))
    with pytest.raises(EngineError, match="vision_encoder: its engine was built for something else"):
        check(load_artifacts(directory), engines, fake.machine())


def test_another_model_needs_another_engine(directory: Path, orin: Artifacts, engines: Path) -> None:
    fake = FakeTensorRt()
    build(orin, engines, silent, fake.machine())
    contents = json.loads((engines / ENGINES_NAME).read_text())
    contents["graphs"]["vision_encoder"]["key"] = "0" * 64
    (engines / ENGINES_NAME).write_text(json.dumps(contents))
    with pytest.raises(EngineError, match=r"vision_encoder: its engine was built for something else \(another model\)"):
        check(orin, engines, fake.machine())


def test_the_key_says_nothing_of_power(orin: Artifacts, engines: Path) -> None:
    build(orin, engines, silent, FakeTensorRt().machine())
    inputs = json.loads((engines / ENGINES_NAME).read_text())["graphs"]["vision_encoder"]["inputs"]
    facts = {"architecture", "device", "l4t", "onnxruntime", "provider_version"}
    assert set(inputs) == facts | {"files", "options", "provider"}
    assert not any("path" in option for option in inputs["options"])


@pytest.mark.parametrize("damage", ["flip", "truncate", "remove", "add"])
def test_a_damaged_engine_is_refused_by_name(orin: Artifacts, engines: Path, damage: str) -> None:
    fake = FakeTensorRt()
    build(orin, engines, silent, fake.machine())
    path = engines / "action_expert" / "TensorrtExecutionProvider_action_expert_sm87.engine"
    data = path.read_bytes()
    if damage == "remove":
        path.unlink()
    elif damage == "add":
        path.with_name("other.engine").write_bytes(b"")
    else:
        path.write_bytes(data[:-1] if damage == "truncate" else bytes([data[0] ^ 1]) + data[1:])
    with pytest.raises(EngineError, match=r"action_expert: .*\.engine is not the file that was built"):
        check(orin, engines, fake.machine())


@pytest.mark.parametrize("text", ["", "[]", "{", '{"schema": 9, "graphs": {}}', '{"schema": 1, "graphs": {"x": 3}}'])
def test_a_damaged_list_of_engines_counts_as_none(orin: Artifacts, engines: Path, text: str) -> None:
    fake = FakeTensorRt()
    build(orin, engines, silent, fake.machine())
    (engines / ENGINES_NAME).write_text(text)
    with pytest.raises(EngineError, match="has no engine"):
        check(orin, engines, fake.machine())
    build(orin, engines, silent, fake.machine())
    check(orin, engines, fake.machine())


def test_a_timing_cache_may_change_later(orin: Artifacts, engines: Path) -> None:
    fake = FakeTensorRt()
    build(orin, engines, silent, fake.machine())
    (engines / "action_expert" / "sm87.timing").write_text("more")
    check(orin, engines, fake.machine())


@pytest.mark.parametrize("same_bytes", [True, False])
def test_an_engine_that_would_be_built_anew_each_time_is_refused(
    orin: Artifacts, engines: Path, same_bytes: bool
) -> None:
    """OpenVINO's provider 1.24.1 does that on a processor: it writes its cache at every opening and reads none."""
    with pytest.raises(EngineError, match="was built anew when the engine was opened again"):
        build(orin, engines, silent, FakeTensorRt(ignores_cache=True, same_bytes=same_bytes).machine())


def test_a_graph_that_the_provider_takes_no_part_of_is_refused(orin: Artifacts, engines: Path) -> None:
    with pytest.raises(EngineError, match="vision_encoder: TensorrtExecutionProvider built no engine"):
        build(orin, engines, silent, FakeTensorRt(takes_nothing=True).machine())
    assert not (engines / "vision_encoder").exists()


def test_an_engine_that_does_not_run_is_refused(orin: Artifacts, engines: Path) -> None:
    with pytest.raises(EngineError, match=r"vision_encoder: its engine does not run \(out of memory\)"):
        build(orin, engines, silent, FakeTensorRt(fails_on="vision_encoder").machine())


def test_a_free_axis_without_a_profile_is_refused(directory: Path, engines: Path) -> None:
    edit(directory, lambda m: m["graphs"]["semantic_context"]["session"]["options"].pop("trt_profile_min_shapes"))
    with pytest.raises(EngineError, match="semantic_context: no min profile for input last_layer_kv"):
        build(load_artifacts(directory), engines, silent, FakeTensorRt().machine())


def test_a_provider_whose_engines_cannot_be_kept_is_refused(directory: Path, engines: Path) -> None:
    cpu = {"provider": "CPUExecutionProvider", "options": {}}
    edit(directory, lambda m: m["graphs"]["vision_encoder"]["session"].update(cpu))
    with pytest.raises(EngineError, match="CPUExecutionProvider is not a provider whose engines can be kept"):
        build(load_artifacts(directory), engines, silent, FakeTensorRt().machine())


def test_progress_names_every_graph_before_its_build(orin: Artifacts, engines: Path) -> None:
    lines: list[str] = []
    build(orin, engines, lines.append, FakeTensorRt().machine())
    started = [line for line in lines if "builds its engine" in line]
    assert [line.split()[0] for line in started] == ["[1/3]", "[2/3]", "[3/3]"]
    assert all(any(name in line for line in started) for name in NEEDING)


def test_the_command_builds_and_reports(directory: Path, engines: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["engines", "--artifacts", str(directory), "--engines", str(engines), "--json", "-"]
    assert main(arguments, FakeTensorRt().machine()) == EXIT_DONE
    result = json.loads(capsys.readouterr().out)
    assert set(result["graphs"]) == set(NEEDING)


def test_the_command_keeps_engines_beside_the_artifacts_unless_told_otherwise(directory: Path) -> None:
    assert main(["engines", "--artifacts", str(directory)], FakeTensorRt().machine()) == EXIT_DONE
    assert (default_directory(directory) / ENGINES_NAME).is_file()
    load_artifacts(directory)


def test_the_command_does_not_write_into_the_sealed_directory(directory: Path) -> None:
    arguments = ["engines", "--artifacts", str(directory), "--engines", str(directory / "engines")]
    assert main(arguments, FakeTensorRt().machine()) == EXIT_BAD_INPUT
    load_artifacts(directory)


def test_the_command_refuses_a_machine_without_the_provider(
    directory: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    fake = FakeTensorRt(providers=["CPUExecutionProvider"])
    assert main(["engines", "--artifacts", str(directory)], fake.machine()) == EXIT_REFUSED
    error = capsys.readouterr().err
    assert "has no TensorrtExecutionProvider, only CPUExecutionProvider" in error
    assert len(error.splitlines()) == 1


def test_the_command_refuses_artifacts_that_do_not_verify(directory: Path) -> None:
    (directory / "tokenizer.json").write_text("{}")
    assert main(["engines", "--artifacts", str(directory)], FakeTensorRt().machine()) == EXIT_REFUSED


def jetson(root: Path) -> Path:
    for name, text in {
        "proc/device-tree/compatible": "nvidia,p3509-0000+p3767-0000\0nvidia,p3767-0000\0nvidia,tegra234\0",
        "etc/nv_tegra_release": "# R36 (release), REVISION: 4.3, GCID: 38968081, BOARD: generic\n",
        "usr/lib/aarch64-linux-gnu/libnvinfer.so.10": "",
        "usr/lib/aarch64-linux-gnu/libnvinfer.so.10.3.0": "",
        "proc/cpuinfo": "processor\t: 0\nmodel name\t: ARMv8 Processor rev 1 (v8l)\n",
    }.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text)
    return root


def test_a_jetson_is_told_by_its_module_release_and_tensorrt(tmp_path: Path) -> None:
    facts = read_device(TENSORRT, jetson(tmp_path), lambda _package: None)
    assert facts.device == "nvidia,p3509-0000+p3767-0000"
    assert (facts.l4t, facts.provider_version) == ("36.4.3", "10.3.0")


def test_a_laptop_is_told_by_its_graphics_card(tmp_path: Path) -> None:
    information = tmp_path / "proc/driver/nvidia/gpus/0000:01:00.0/information"
    information.parent.mkdir(parents=True)
    information.write_text("Model: \t\t NVIDIA GeForce RTX 4060 Laptop GPU\nIRQ:   \t\t 190\n")
    facts = read_device(TENSORRT, tmp_path, {"tensorrt-cu12": "10.7.0"}.get)
    assert facts.device == "NVIDIA GeForce RTX 4060 Laptop GPU"
    assert (facts.l4t, facts.provider_version) == (None, "10.7.0")


def test_an_engine_for_the_processor_depends_on_the_processor(tmp_path: Path) -> None:
    facts = read_device(OPENVINO, jetson(tmp_path), {"openvino": "2026.4.1"}.get)
    assert facts.device == "ARMv8 Processor rev 1 (v8l)"
    assert facts.provider_version == "2026.4.1"


def test_a_machine_that_says_nothing_is_unknown_not_an_error(tmp_path: Path) -> None:
    facts = read_device(TENSORRT, tmp_path, lambda _package: None)
    assert (facts.device, facts.l4t, facts.provider_version) == ("unknown", None, None)


@pytest.mark.parametrize("text", ["", "R36", "# R35"])
def test_what_is_not_a_release_is_none(text: str) -> None:
    assert l4t_release(text) is None


def test_power_modes_are_found_by_name() -> None:
    assert power_modes(CONF) == {"MAXN_SUPER": 0, "25W": 3, "40W": 4}
    assert current_power_mode("NVPM VERB: Current\nNV Power Mode: 25W\n3\n") == "25W"
    assert current_power_mode("") is None


def test_the_mode_that_the_plan_was_made_for_is_accepted() -> None:
    check_power_mode("25W", conf=CONF, query="NV Power Mode: 25W\n3\n")


def test_a_mode_that_the_board_does_not_have_is_refused_with_those_it_has() -> None:
    with pytest.raises(DeviceError, match="'20W' is not on this board; it has MAXN_SUPER, 25W, 40W"):
        check_power_mode("20W", conf=CONF, query="NV Power Mode: 25W\n3\n")


def test_another_mode_is_refused_with_the_command_that_sets_it() -> None:
    with pytest.raises(DeviceError, match="power mode is 25W, the plan was made for 40W: sudo nvpmodel -m 4"):
        check_power_mode("40W", conf=CONF, query="NV Power Mode: 25W\n3\n")


def test_a_runner_without_the_engines_refuses_before_anything_moves(
    artifacts_dir: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    from edge.runner import main as run

    copy = Path(shutil.copytree(artifacts_dir, tmp_path / "nano"))
    manifest = json.loads((copy / "manifest.json").read_text())
    manifest["graphs"]["vision_encoder"]["session"].update(provider="TensorrtExecutionProvider", engine=True)
    (copy / "manifest.json").write_text(json.dumps(seal(manifest)))
    robot = Path(__file__).parents[3] / "firmware_bridge/robots/go2_sim.toml"
    code = run(["--artifacts", str(copy), "--robot", str(robot), "--instruction", "go", "--duration", "1"])
    error = capfd.readouterr().err
    assert code == 3
    assert error.count("\n") == 1
    assert "vision_encoder" in error and "edge-install engines" in error
