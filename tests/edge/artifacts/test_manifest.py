"""Nothing in an artifact directory is opened before all of it has been verified."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from edge.artifacts.files import SCHEMA_VERSION, ArtifactError, seal
from edge.artifacts.manifest import load_artifacts
from edge.artifacts.provider_options import wrong_option
from edge.inference.engines import PROFILES
from edge.inference.graph import Graph
from edge.inference.language import LanguageModel
from edge.inference.policy import Policy
from edge.state.switches import Decoding, RecoverySwitch
from export.cli import main
from export.targets.file import load_target


@pytest.fixture
def copy(artifacts_dir: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(artifacts_dir, tmp_path / "nano"))


def edit(directory: Path, change: Callable[[dict[str, Any]], None]) -> None:
    path = directory / "manifest.json"
    manifest = json.loads(path.read_text())
    change(manifest)
    path.write_text(json.dumps(seal(manifest)))


def test_a_fresh_export_is_accepted(artifacts_dir: Path) -> None:
    artifacts = load_artifacts(artifacts_dir)
    assert artifacts.model_name == "nano"
    assert not artifacts.trained


@pytest.mark.parametrize("name", ["vision_encoder.onnx", "language_model.onnx", "tokenizer.json", "report.html"])
def test_one_flipped_bit_anywhere_is_refused_by_name(copy: Path, name: str) -> None:
    data = bytearray((copy / name).read_bytes())
    data[len(data) // 2] ^= 1
    (copy / name).write_bytes(data)
    with pytest.raises(ArtifactError, match=rf"{name}: sha256"):
        load_artifacts(copy)


@pytest.mark.parametrize("section", ["runtime", "graphs", "model", "provenance", "plan"])
def test_a_change_anywhere_in_the_manifest_is_refused(copy: Path, section: str) -> None:
    path = copy / "manifest.json"
    manifest = json.loads(path.read_text())
    manifest[section]["tick_period_ms"] = 900
    path.write_text(json.dumps(manifest))
    with pytest.raises(ArtifactError, match=r"manifest.json: sha256 of its content"):
        load_artifacts(copy)


@given(data=st.data())
@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_no_flipped_bit_of_the_manifest_is_accepted(copy: Path, data: st.DataObject) -> None:
    path = copy / "manifest.json"
    whole = path.read_bytes()
    position = data.draw(st.integers(0, len(whole) - 1))
    flipped = bytearray(whole)
    flipped[position] ^= 1 << data.draw(st.integers(0, 7))
    try:
        same = json.loads(bytes(flipped)) == json.loads(whole)
    except ValueError:
        same = False
    path.write_bytes(bytes(flipped))
    try:
        if not same:  # a space that became a tab says the same
            with pytest.raises(ArtifactError, match=r"manifest\.json"):
                load_artifacts(copy)
    finally:
        path.write_bytes(whole)


def test_a_truncated_file_is_refused(copy: Path) -> None:
    data = (copy / "action_expert.onnx").read_bytes()
    (copy / "action_expert.onnx").write_bytes(data[:-1])
    with pytest.raises(ArtifactError, match=r"action_expert.onnx: \d+ bytes, the manifest says"):
        load_artifacts(copy)


def test_a_missing_file_is_refused(copy: Path) -> None:
    (copy / "tokenizer.json").unlink()
    with pytest.raises(ArtifactError, match=r"tokenizer.json: missing"):
        load_artifacts(copy)


def test_a_file_that_is_not_listed_is_refused(copy: Path) -> None:
    (copy / "weights.pkl").write_bytes(b"\x80\x04")
    with pytest.raises(ArtifactError, match="not listed"):
        load_artifacts(copy)


def test_a_symlink_is_refused(copy: Path, tmp_path: Path) -> None:
    outside = tmp_path / "outside.json"
    shutil.move(copy / "tokenizer.json", outside)
    (copy / "tokenizer.json").symlink_to(outside)
    with pytest.raises(ArtifactError, match="not a regular file"):
        load_artifacts(copy)


@pytest.mark.parametrize("name", ["../evil.onnx", "/etc/passwd", "a/b", "", ".hidden", "manifest.json"])
def test_a_listed_path_that_leaves_the_directory_is_refused(copy: Path, name: str) -> None:
    edit(copy, lambda m: m["files"].update({name: {"bytes": 1, "sha256": "0" * 64}}))
    with pytest.raises(ArtifactError, match="not a plain name"):
        load_artifacts(copy)


@pytest.mark.parametrize("version", [0, SCHEMA_VERSION - 1, SCHEMA_VERSION + 1, str(SCHEMA_VERSION), None])
def test_another_schema_version_is_refused(copy: Path, version: object) -> None:
    edit(copy, lambda m: m.update(schema_version=version))
    with pytest.raises(ArtifactError, match="schema version"):
        load_artifacts(copy)


@pytest.mark.parametrize("section", ["graphs", "files", "runtime", "model", "provenance", "target"])
def test_a_missing_section_is_refused(copy: Path, section: str) -> None:
    edit(copy, lambda m: m.pop(section))
    with pytest.raises(ArtifactError, match=section):
        load_artifacts(copy)


@pytest.mark.parametrize("content", ["", "[]", "{", "[" * 100_000])
def test_a_manifest_that_is_no_object_is_refused(copy: Path, content: str) -> None:
    (copy / "manifest.json").write_text(content)
    with pytest.raises(ArtifactError):
        load_artifacts(copy)


def test_a_directory_that_is_none_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ArtifactError, match="not a directory"):
        load_artifacts(tmp_path / "nothing")


def test_widths_that_do_not_fit_one_another_are_refused(copy: Path) -> None:
    edit(copy, lambda m: m["runtime"].update(kv_dim=128))
    with pytest.raises(ArtifactError, match="last_layer_kv"):
        load_artifacts(copy)


@pytest.mark.parametrize(
    "change",
    [
        {"tick_period_ms": 0},
        {"frame_offsets_s": []},
        {"frame_offsets_s": [1e5]},
        {"control_cores": 3},
        {"reasoning_cores": [-1]},
        {"control_priority": 60},  # the bridge's
        {"control_priority": 100},
        {"max_context": 0},
        {"max_new_tokens": -1},
        {"step_s": "0.1"},
        {"image_px": True},
    ],
    ids=str,
)
def test_runtime_values_that_cannot_be_run_are_refused(copy: Path, change: dict[str, Any]) -> None:
    edit(copy, lambda m: m["runtime"].update(change))
    with pytest.raises(ArtifactError, match="runtime"):
        load_artifacts(copy)


def test_a_manifest_from_before_the_switches_gets_their_defaults(copy: Path) -> None:
    edit(copy, lambda m: [m["runtime"].pop(key, None) for key in ("decoding", "recovery")])
    runtime = load_artifacts(copy).runtime
    assert (runtime.decoding, runtime.recovery) == (Decoding.CONSTRAINED, RecoverySwitch.ON)


def test_a_manifest_has_defaults_of_the_switches(copy: Path) -> None:
    edit(copy, lambda m: m["runtime"].update(decoding="free", recovery="off"))
    runtime = load_artifacts(copy).runtime
    assert (runtime.decoding, runtime.recovery) == (Decoding.FREE, RecoverySwitch.OFF)


@pytest.mark.parametrize("change", [{"decoding": "loose"}, {"recovery": True}, {"recovery": 1}, {"decoding": None}])
def test_a_switch_that_does_not_exist_is_refused(copy: Path, change: dict[str, Any]) -> None:
    edit(copy, lambda m: m["runtime"].update(change))
    with pytest.raises(ArtifactError, match=r"expected.*constrained"):
        load_artifacts(copy)


def test_an_unknown_runtime_key_is_refused(copy: Path) -> None:
    edit(copy, lambda m: m["runtime"].update(max_speed=9))
    with pytest.raises(ArtifactError, match="runtime has"):
        load_artifacts(copy)


def test_a_graph_that_is_not_what_the_manifest_says_is_refused_when_opened(copy: Path) -> None:
    swapped = (copy / "semantic_context.onnx").read_bytes()
    (copy / "action_expert.onnx").write_bytes(swapped)
    entry = {"bytes": len(swapped), "sha256": hashlib.sha256(swapped).hexdigest()}
    edit(copy, lambda m: m["files"].update({"action_expert.onnx": entry}))
    with pytest.raises(ArtifactError, match="not those of the manifest"):
        Graph(load_artifacts(copy), "action_expert", threads=1)


def replace(directory: Path, name: str, data: bytes) -> None:
    (directory / name).write_bytes(data)
    entry = {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}
    edit(directory, lambda m: m["files"].update({name: entry}))


def test_weights_outside_the_graph_cannot_be_reached(copy: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    proto = onnx.load(str(copy / "semantic_context.onnx"))
    onnx.external_data_helper.convert_model_to_external_data(proto, location="planted.bin", size_threshold=0)
    onnx.save(proto, str(copy.parent / "external.onnx"))
    replace(copy, "semantic_context.onnx", (copy.parent / "external.onnx").read_bytes())
    # The file is there, in the working directory, with weights of the right size.
    monkeypatch.chdir(copy.parent)
    assert Path("planted.bin").exists()
    with pytest.raises(ArtifactError, match=r"semantic_context\.onnx: weights in 'planted\.bin'"):
        load_artifacts(copy)


def test_a_tokenizer_that_is_none_is_refused(copy: Path) -> None:
    replace(copy, "tokenizer.json", b"{}")
    with pytest.raises(ArtifactError, match="not a tokenizer"):
        LanguageModel(load_artifacts(copy))


def test_a_file_that_is_no_graph_is_refused(copy: Path) -> None:
    replace(copy, "action_expert.onnx", b"not a graph")
    with pytest.raises(ArtifactError, match=r"action_expert\.onnx: not an ONNX model"):
        load_artifacts(copy)


def test_a_graph_that_onnx_runtime_does_not_take_is_refused_when_opened(copy: Path) -> None:
    replace(copy, "action_expert.onnx", onnx.ModelProto(ir_version=10).SerializeToString())
    with pytest.raises(ArtifactError, match="cannot open"):
        Graph(load_artifacts(copy), "action_expert", threads=1)


@pytest.mark.parametrize("name", ["model.pt", "weights.npy", "weights.pkl", "run.sh", "plugin.so", "model.onnx.py"])
def test_a_listed_file_of_a_kind_that_artifacts_never_have_is_refused(copy: Path, name: str) -> None:
    replace(copy, name, b"harmless")
    with pytest.raises(ArtifactError, match=rf"{name}.*of no kind that artifacts have"):
        load_artifacts(copy)


@pytest.mark.parametrize(
    ("head", "kind"), [(b"\x80\x04\x95", "a pickle"), (b"PK\x03\x04", "a zip archive"), (b"\x93NUMPY\x01", "a NumPy")]
)
def test_a_pickle_under_another_name_is_refused_by_its_content(copy: Path, head: bytes, kind: str) -> None:
    replace(copy, "report.json", head + b"...")
    with pytest.raises(ArtifactError, match=rf"report\.json: is {kind}"):
        load_artifacts(copy)


@pytest.mark.parametrize("name", ["tokenizer.json", "manifest.json"])
def test_a_pipe_in_the_place_of_a_file_is_refused_and_not_waited_for(copy: Path, name: str) -> None:
    (copy / name).unlink()
    os.mkfifo(copy / name)
    with pytest.raises(ArtifactError, match="not a regular file"):
        load_artifacts(copy)


def test_a_manifest_that_is_a_symlink_is_refused(copy: Path, tmp_path: Path) -> None:
    shutil.move(copy / "manifest.json", tmp_path / "manifest.json")
    (copy / "manifest.json").symlink_to(tmp_path / "manifest.json")
    with pytest.raises(ArtifactError, match=r"manifest\.json: cannot be read"):
        load_artifacts(copy)


@pytest.fixture(scope="module")
def mapped(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """`nano` with its encoder's weights in a data file, as large graphs have them."""
    out = tmp_path_factory.mktemp("mapped") / "nano"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("export.graphs.build.SINGLE_FILE_BYTES", 5_000_000)
        assert main(["--target", "cpu", "--random-weights", "0", "--no-cache", "--out", str(out)]) == 0
    return out


@pytest.fixture
def mapped_copy(mapped: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(mapped, tmp_path / "mapped"))


DATA = "vision_encoder.onnx.data"


@pytest.mark.slow
def test_weights_in_a_data_file_compute_the_same(mapped: Path, artifacts_dir: Path) -> None:
    assert (mapped / DATA).exists() and not (artifacts_dir / DATA).exists()
    frame = np.random.default_rng(0).integers(0, 256, (1, 128, 128, 3)).astype(np.uint8)
    inside, outside = (Policy(load_artifacts(d)).encode(frame) for d in (artifacts_dir, mapped))
    np.testing.assert_array_equal(inside, outside)


def test_one_flipped_bit_in_a_data_file_is_refused_by_name(mapped_copy: Path) -> None:
    data = bytearray((mapped_copy / DATA).read_bytes())
    data[len(data) // 2] ^= 1
    (mapped_copy / DATA).write_bytes(data)
    with pytest.raises(ArtifactError, match=rf"{DATA}: sha256"):
        load_artifacts(mapped_copy)


def test_a_data_file_that_was_replaced_after_its_hash_was_checked_is_refused(mapped_copy: Path) -> None:
    artifacts = load_artifacts(mapped_copy)
    other = mapped_copy.parent / "other"
    other.write_bytes((mapped_copy / DATA).read_bytes())
    other.replace(mapped_copy / DATA)
    with pytest.raises(ArtifactError, match=rf"{DATA}: changed while"):
        Graph(artifacts, "vision_encoder", threads=1)


def test_a_data_file_rewritten_in_place_with_its_time_of_writing_restored_is_refused(mapped_copy: Path) -> None:
    artifacts, path = load_artifacts(mapped_copy), mapped_copy / DATA
    before, data = path.stat(), bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    with path.open("r+b") as file:
        file.write(data)
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))
    after = path.stat()
    assert (after.st_ino, after.st_size, after.st_mtime_ns) == (before.st_ino, before.st_size, before.st_mtime_ns)
    with pytest.raises(ArtifactError, match=rf"{DATA}: changed while"):
        Graph(artifacts, "vision_encoder", threads=1)


def test_a_data_file_swapped_by_renames_while_it_was_opened_is_refused_although_the_first_is_back(
    mapped_copy: Path,
) -> None:
    artifacts, path = load_artifacts(mapped_copy), mapped_copy / DATA
    aside = path.rename(mapped_copy.parent / "aside")
    path.write_bytes(bytes(aside.stat().st_size))  # what a session would be opened on
    aside.replace(path)
    with pytest.raises(ArtifactError, match=rf"{DATA}: changed while"):
        artifacts.check_unchanged([DATA])


def test_a_data_file_with_a_second_name_is_refused(mapped_copy: Path, tmp_path: Path) -> None:
    (tmp_path / "second-name").hardlink_to(mapped_copy / DATA)
    with pytest.raises(ArtifactError, match=rf"{DATA}: has 2 names"):
        load_artifacts(mapped_copy)


def test_a_data_file_that_is_a_symlink_is_refused(mapped_copy: Path, tmp_path: Path) -> None:
    shutil.move(mapped_copy / DATA, tmp_path / "weights")
    (mapped_copy / DATA).symlink_to(tmp_path / "weights")
    with pytest.raises(ArtifactError, match=rf"{DATA}: missing or not a regular file"):
        load_artifacts(mapped_copy)


def external_weights(directory: Path, change: Callable[[Any], None]) -> None:
    """Change the first reference to external data in the encoder, as somebody would who also fixes the hashes."""
    model = onnx.load(str(directory / "vision_encoder.onnx"), load_external_data=False)
    change(next(tensor for tensor in model.graph.initializer if tensor.external_data))
    replace(directory, "vision_encoder.onnx", model.SerializeToString())


def entry_set(key: str, value: str) -> Callable[[Any], None]:
    """A change of one entry of a tensor's external data, added when it is not there."""

    def change(tensor: Any) -> None:
        for entry in tensor.external_data:
            if entry.key == key:
                entry.value = value
                return
        entry = tensor.external_data.add()
        entry.key, entry.value = key, value

    return change


@pytest.mark.parametrize(
    ("key", "value", "said"),
    [
        ("location", "../outside.bin", "does not list"),
        ("location", "/etc/passwd", "does not list"),
        ("location", "./vision_encoder.onnx.data", "does not list"),
        ("location", "tokenizer.json", "does not list"),
        ("location", "", "does not list"),
        ("offset", "-8", "expected a number"),
        ("offset", "99999999999", "beyond the"),
        ("length", "99999999999", "beyond the"),
        ("length", "1e3", "expected a number"),
        ("basepath", "/etc", "with the key 'basepath'"),
        ("__class__", "x", "with the key '__class__'"),
    ],
)
def test_external_data_that_leaves_its_listed_file_is_refused(
    mapped_copy: Path, key: str, value: str, said: str
) -> None:
    external_weights(mapped_copy, entry_set(key, value))
    with pytest.raises(ArtifactError, match=rf"vision_encoder\.onnx: .*{said}"):
        load_artifacts(mapped_copy)


def test_external_data_given_twice_is_refused(mapped_copy: Path) -> None:
    def change(tensor: Any) -> None:
        entry = tensor.external_data.add()
        entry.key, entry.value = "location", "../outside.bin"

    external_weights(mapped_copy, change)
    with pytest.raises(ArtifactError, match="once each"):
        load_artifacts(mapped_copy)


def test_a_data_file_that_the_manifest_does_not_list_is_refused(mapped_copy: Path) -> None:
    edit(mapped_copy, lambda m: m["files"].pop(DATA))
    with pytest.raises(ArtifactError, match="not listed"):
        load_artifacts(mapped_copy)


@pytest.mark.parametrize(
    "session", [None, {}, {"provider": 1, "options": {}, "threads": None, "engine": False}], ids=str
)
def test_a_graph_without_a_whole_session_entry_is_refused(copy: Path, session: object) -> None:
    edit(copy, lambda m: m["graphs"]["vision_encoder"].update(session=session))
    with pytest.raises(ArtifactError, match="session"):
        load_artifacts(copy)


@pytest.mark.parametrize(
    ("provider", "options"),
    [
        ("TensorrtExecutionProvider", {"trt_extra_plugin_lib_paths": "language_model.onnx.data"}),
        ("TensorrtExecutionProvider", {"trt_engine_cache_path": "engines"}),
        ("TensorrtExecutionProvider", {"trt_fp16_enable": "/tmp/plugin.so"}),
        ("CUDAExecutionProvider", {"gpu_mem_limit": "../plugin"}),
        ("CPUExecutionProvider", {"anything": "1"}),
        ("QNNExecutionProvider", {"backend_path": "libQnnHtp.so"}),
    ],
    ids=str,
)
def test_a_session_option_that_could_load_a_file_is_refused(copy: Path, provider: str, options: dict[str, str]) -> None:
    edit(copy, lambda m: m["graphs"]["vision_encoder"]["session"].update(provider=provider, options=options))
    with pytest.raises(ArtifactError, match=rf"vision_encoder: session option .*{next(iter(options))}"):
        load_artifacts(copy)


@pytest.mark.parametrize("target", ["cpu", "orin", "rtx4060"])
def test_the_session_options_of_the_shipped_targets_are_taken(target: str) -> None:
    for provider in load_target(target).providers.values():
        profile = {f"trt_profile_{kind}_shapes": "a.b:1x2,c:3x4" for kind in PROFILES} if provider.engine else {}
        assert wrong_option(provider.name, {**provider.options, **profile}) is None


def test_a_provider_that_this_machine_lacks_is_refused_by_name(copy: Path) -> None:
    edit(copy, lambda m: m["graphs"]["vision_encoder"]["session"].update(provider="QNNExecutionProvider"))
    with pytest.raises(ArtifactError, match="made for QNNExecutionProvider"):
        Graph(load_artifacts(copy), "vision_encoder", threads=1)
