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

from edge.artifacts.manifest import Artifacts, load_artifacts
from edge.core.cli import EXIT_BAD_INPUT, EXIT_DONE, EXIT_REFUSED
from edge.core.device import TENSORRT, DeviceFacts
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
from edge.run.command import main as run
from export.targets.file import load_target
from tests.support.artifact_directory import edit_manifest

NEEDING = ("vision_encoder", "semantic_context", "action_expert")
FACTS = DeviceFacts("aarch64", "nvidia,p3767-0000", "36.4.3", "1.25.1", "10.3.0")


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


def for_orin(manifest: dict[str, Any]) -> None:
    target = load_target("orin", "nano")
    for name in NEEDING:
        entry = manifest["graphs"][name]
        entry["session"] = target.session(name, entry["inputs"])


@pytest.fixture
def directory(artifacts_dir: Path, tmp_path: Path) -> Path:
    copy = Path(shutil.copytree(artifacts_dir, tmp_path / "orin"))
    edit_manifest(copy, for_orin)
    return copy


@pytest.fixture
def orin(directory: Path) -> Artifacts:
    return load_artifacts(directory)


@pytest.fixture
def engines(tmp_path: Path) -> Path:
    return tmp_path / "engines"


def silent(_line: str) -> None:
    pass


@pytest.fixture
def built(orin: Artifacts, engines: Path) -> FakeTensorRt:
    """A device that has built every engine."""
    fake = FakeTensorRt()
    build(orin, engines, silent, fake.machine())
    return fake


def test_only_graphs_of_a_provider_that_compiles_need_an_engine(orin: Artifacts, artifacts: Artifacts) -> None:
    assert set(needed(orin)) == set(NEEDING)
    assert needed(artifacts) == []


def engine_file(engines: Path) -> Path:
    return next((engines / "vision_encoder").glob("*.engine"))


def test_an_engine_rewritten_after_its_hash_was_checked_with_its_time_restored_is_refused(
    built: FakeTensorRt, orin: Artifacts, engines: Path
) -> None:
    verified, path = check(orin, engines, built.machine()), engine_file(engines)
    before = path.stat()
    path.write_bytes(bytes(before.st_size))
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))
    with pytest.raises(EngineError, match=r"\.engine: changed while"):
        verified.check_unchanged()


def test_an_engine_swapped_by_renames_while_it_was_opened_is_refused_although_the_first_is_back(
    built: FakeTensorRt, orin: Artifacts, engines: Path, tmp_path: Path
) -> None:
    verified, path = check(orin, engines, built.machine()), engine_file(engines)
    aside = path.rename(tmp_path / "aside")
    path.write_bytes(b"another engine")
    aside.replace(path)
    with pytest.raises(EngineError, match=r"\.engine: changed while"):
        verified.check_unchanged()


def test_artifacts_without_engines_need_no_build(artifacts: Artifacts, engines: Path) -> None:
    check(artifacts, engines).check_unchanged()
    assert build(artifacts, engines, silent) == {}


def test_built_engines_are_accepted_and_can_be_opened(orin: Artifacts, engines: Path) -> None:
    fake = FakeTensorRt()
    results = build(orin, engines, silent, fake.machine())
    check(orin, engines, fake.machine()).check_unchanged()
    assert set(results) == set(NEEDING)
    assert all(result["built"] for result in results.values())


def test_the_runner_finds_the_built_engines_and_compiles_nothing(
    built: FakeTensorRt, orin: Artifacts, engines: Path
) -> None:
    ready, compiled = with_engines(orin, engines), list(built.compiled)
    for name in NEEDING:
        built.open(ready, name)
    assert built.compiled == compiled == list(needed(orin))


def test_every_shape_of_the_profiles_is_run_at_build_time(built: FakeTensorRt, orin: Artifacts, engines: Path) -> None:
    lengths = {shape[1] for name, shape in built.shapes if name == "last_layer_kv"}
    assert lengths == {1, 240, 512}
    fixed = {shape for name, shape in built.shapes if name == "frame"}
    assert fixed == {(1, 128, 128, 3)}


@pytest.mark.slow
def test_a_profile_shorter_than_the_models_context_is_refused(directory: Path, engines: Path) -> None:
    edit_manifest(directory, lambda m: m["runtime"].update(max_context=513))
    edit_manifest(directory, lambda m: m["model"].get("config", {}).pop("language", None))
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


OTHER_DEVICES = [
    ({"onnxruntime": "1.26.0"}, "onnxruntime 1.25.1 → 1.26.0"),
    ({"provider_version": "10.7.0"}, "provider_version 10.3.0 → 10.7.0"),
    ({"device": "nvidia,p3767-0001"}, "device nvidia,p3767-0000 → nvidia,p3767-0001"),
    ({"l4t": "36.5.0"}, "l4t 36.4.3 → 36.5.0"),
]


@pytest.mark.parametrize(("change", "difference"), OTHER_DEVICES)
def test_an_engine_of_another_device_or_release_is_refused_with_the_difference(
    built: FakeTensorRt, orin: Artifacts, engines: Path, change: dict[str, str], difference: str
) -> None:
    built.facts = replace(FACTS, **change)
    with pytest.raises(EngineError, match=f"was built for something else.*{difference}"):
        check(orin, engines, built.machine())


def test_other_options_and_another_model_need_another_engine(
    built: FakeTensorRt, directory: Path, orin: Artifacts, engines: Path
) -> None:
    contents = json.loads((engines / ENGINES_NAME).read_text())
    contents["graphs"]["vision_encoder"]["key"] = "0" * 64
    (engines / ENGINES_NAME).write_text(json.dumps(contents))
    with pytest.raises(EngineError, match=r"vision_encoder: its engine was built for something else \(another model\)"):
        check(orin, engines, built.machine())
    edit_manifest(directory, lambda m: m["graphs"]["vision_encoder"]["session"]["options"].update(trt_fp16_enable="0"))
    with pytest.raises(EngineError, match="vision_encoder: its engine was built for something else"):
        check(load_artifacts(directory), engines, built.machine())


def test_the_key_does_not_depend_on_power(orin: Artifacts, engines: Path) -> None:
    build(orin, engines, silent, FakeTensorRt().machine())
    inputs = json.loads((engines / ENGINES_NAME).read_text())["graphs"]["vision_encoder"]["inputs"]
    facts = {"architecture", "device", "l4t", "onnxruntime", "provider_version"}
    assert set(inputs) == facts | {"files", "options", "provider"}
    assert not any("path" in option for option in inputs["options"])


@pytest.mark.parametrize("damage", ["flip", "truncate", "remove", "add"])
def test_a_damaged_engine_is_refused_by_name(built: FakeTensorRt, orin: Artifacts, engines: Path, damage: str) -> None:
    path = engines / "action_expert" / "TensorrtExecutionProvider_action_expert_sm87.engine"
    data = path.read_bytes()
    if damage == "remove":
        path.unlink()
    elif damage == "add":
        path.with_name("other.engine").write_bytes(b"")
    else:
        path.write_bytes(data[:-1] if damage == "truncate" else bytes([data[0] ^ 1]) + data[1:])
    with pytest.raises(EngineError, match=r"action_expert: .*\.engine is not the file that was built"):
        check(orin, engines, built.machine())


@pytest.mark.parametrize("text", ["", "[]", "{", '{"schema": 9, "graphs": {}}', '{"schema": 1, "graphs": {"x": 3}}'])
def test_a_damaged_list_of_engines_counts_as_none(
    built: FakeTensorRt, orin: Artifacts, engines: Path, text: str
) -> None:
    (engines / ENGINES_NAME).write_text(text)
    with pytest.raises(EngineError, match="has no engine"):
        check(orin, engines, built.machine())
    build(orin, engines, silent, built.machine())
    (engines / "action_expert" / "sm87.timing").write_text("more")  # a timing cache may change later
    check(orin, engines, built.machine())


def without_profile(graphs: dict[str, Any]) -> None:
    graphs["semantic_context"]["session"]["options"].pop("trt_profile_min_shapes")


def on_the_processor(graphs: dict[str, Any]) -> None:
    graphs["vision_encoder"]["session"].update(provider="CPUExecutionProvider", options={})


@pytest.mark.slow
@pytest.mark.parametrize(
    ("fake", "change", "message"),
    [
        # OpenVINO's provider 1.24.1 does that on a processor: it writes its cache at every opening and reads none.
        *(
            (FakeTensorRt(ignores_cache=True, same_bytes=same), None, "built anew when the engine was opened again")
            for same in (True, False)
        ),
        (FakeTensorRt(takes_nothing=True), None, "TensorrtExecutionProvider built no engine"),
        (FakeTensorRt(fails_on="semantic_context"), None, r"its engine does not run \(out of memory\)"),
        (FakeTensorRt(), without_profile, "no min profile for input last_layer_kv"),
        (FakeTensorRt(), on_the_processor, "CPUExecutionProvider is not a provider whose engines can be kept"),
    ],
    ids=["built anew", "the same bytes anew", "no engine", "does not run", "no profile", "another provider"],
)
def test_an_engine_that_cannot_be_kept_is_refused(
    directory: Path, engines: Path, fake: FakeTensorRt, change: Callable[[dict[str, Any]], None] | None, message: str
) -> None:
    if change is not None:
        edit_manifest(directory, lambda m: change(m["graphs"]))
    with pytest.raises(EngineError, match=message):
        build(load_artifacts(directory), engines, silent, fake.machine())
    assert not list(engines.glob("*.partial"))


@pytest.mark.slow
def test_the_command_builds_reports_and_names_every_graph_before_its_build(
    directory: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["engines", "--artifacts", str(directory), "--json", "-"]
    assert main(arguments, FakeTensorRt().machine()) == EXIT_DONE
    output = capsys.readouterr()
    assert set(json.loads(output.out)["graphs"]) == set(NEEDING)
    started = [line for line in output.err.splitlines() if "builds its engine" in line]
    assert len(started) == 3 and all(f"[{k}/3]" in line for k, line in enumerate(started, 1))
    assert all(any(name in line for line in started) for name in NEEDING)
    assert (default_directory(directory) / ENGINES_NAME).is_file()  # beside the sealed directory
    load_artifacts(directory)


@pytest.mark.slow
def test_the_command_does_not_write_into_the_sealed_directory(directory: Path) -> None:
    arguments = ["engines", "--artifacts", str(directory), "--engines", str(directory / "engines")]
    assert main(arguments, FakeTensorRt().machine()) == EXIT_BAD_INPUT
    load_artifacts(directory)


@pytest.mark.slow
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


@pytest.mark.slow
def test_a_runner_without_the_engines_refuses_before_anything_moves(
    directory: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    robot = Path(__file__).parents[3] / "firmware_bridge/robots/go2_sim.toml"
    code = run(["--artifacts", str(directory), "--robot", str(robot), "--instruction", "go", "--duration", "1"])
    error = capfd.readouterr().err
    assert code == EXIT_REFUSED
    assert error.count("\n") == 1
    assert "vision_encoder" in error and "edge-install engines" in error
