"""Nothing in an artifact directory is opened before all of it has been verified."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from edge.artifacts.files import SCHEMA_VERSION, ArtifactError
from edge.artifacts.manifest import load_artifacts
from edge.artifacts.providers import opened_with, wrong_option
from edge.inference.engines import PROFILES
from edge.inference.graph import Graph
from edge.inference.language import LanguageModel
from edge.inference.policy import Policy
from edge.state.switches import Decoding, RecoverySwitch
from export.model.config import PRESETS
from export.model.network import build
from export.targets.file import load_target
from tests.support.artifact_directory import edit_manifest, flip_bit, replace_file, write_artifacts


@pytest.fixture
def copy(artifacts_dir: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(artifacts_dir, tmp_path / "nano"))


def test_a_fresh_export_is_accepted(artifacts_dir: Path) -> None:
    artifacts = load_artifacts(artifacts_dir)
    assert artifacts.model_name == "nano"
    assert not artifacts.trained


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


def link_to_outside(directory: Path, name: str) -> None:
    outside = directory.parent / "outside"
    shutil.move(directory / name, outside)
    (directory / name).symlink_to(outside)


def put_pipe(directory: Path, name: str) -> None:
    (directory / name).unlink()
    os.mkfifo(directory / name)


def cut(directory: Path, name: str) -> None:
    (directory / name).write_bytes((directory / name).read_bytes()[:-1])


DAMAGE: dict[str, tuple[Callable[[Path], object], str]] = {
    "a truncated file": (lambda d: cut(d, "action_expert.onnx"), r"action_expert.onnx: \d+ bytes, the manifest lists"),
    "a missing file": (lambda d: (d / "tokenizer.json").unlink(), r"tokenizer.json: missing"),
    "a file that is not listed": (lambda d: (d / "weights.pkl").write_bytes(b"\x80\x04"), "not listed"),
    "a symlink": (lambda d: link_to_outside(d, "tokenizer.json"), "not a regular file"),
    "a symlink for the manifest": (lambda d: link_to_outside(d, "manifest.json"), r"manifest\.json: cannot be read"),
    "a pipe": (lambda d: put_pipe(d, "tokenizer.json"), "not a regular file"),
    "a pipe for the manifest": (lambda d: put_pipe(d, "manifest.json"), "not a regular file"),
    "no graph": (
        lambda d: replace_file(d, "action_expert.onnx", b"not a graph"),
        r"action_expert\.onnx: not an ONNX model",
    ),
    "no directory": (shutil.rmtree, "not a directory"),
    **{
        f"a manifest of {content[:9]!r}": (lambda d, text=content: (d / "manifest.json").write_text(text), "manifest")
        for content in ("", "[]", "{", "[" * 100_000)
    },
}
for name in ("vision_encoder.onnx", "language_model.onnx", "tokenizer.json", "report.html"):
    DAMAGE[f"a flipped bit in {name}"] = (partial(flip_bit, name=name), rf"{name}: sha256")
for name in ("model.pt", "weights.npy", "weights.pkl", "run.sh", "plugin.so", "model.onnx.py"):
    DAMAGE[name] = (partial(replace_file, name=name, data=b"harmless"), rf"{name}.*of no kind that artifacts have")
for head, kind in ((b"\x80\x04\x95", "a pickle"), (b"PK\x03\x04", "a zip archive"), (b"\x93NUMPY\x01", "a NumPy")):
    DAMAGE[kind] = (partial(replace_file, name="report.json", data=head + b"..."), rf"report\.json: is {kind}")


@pytest.mark.parametrize(("damage", "message"), DAMAGE.values(), ids=DAMAGE)
def test_a_damaged_directory_is_refused(copy: Path, damage: Callable[[Path], object], message: str) -> None:
    damage(copy)
    with pytest.raises(ArtifactError, match=message):
        load_artifacts(copy)


Edit = Callable[[dict[str, Any]], object]


def listed(name: str) -> Edit:
    return lambda m: m["files"].update({name: {"bytes": 1, "sha256": "0" * 64}})


def with_runtime(**values: object) -> Edit:
    return lambda m: m["runtime"].update(values)


def with_session(session: object) -> Edit:
    return lambda m: m["graphs"]["vision_encoder"].update(session=session)


def version(number: object) -> Edit:
    return lambda m: m.update(schema_version=number)


def without(section: str) -> Edit:
    return lambda m: m.pop(section)


LARGE = {"bytes": 500 << 20, "sha256": "0" * 64}


def nested(depth: int) -> object:
    content: object = {}
    for _ in range(depth):
        content = {"x": content}
    return content


WRONG: list[tuple[str, list[Edit]]] = [
    (
        "not a plain name",
        [listed(name) for name in ("../evil.onnx", "/etc/passwd", "a/b", "", ".hidden", "manifest.json")],
    ),
    ("schema version", [version(n) for n in (0, SCHEMA_VERSION - 1, SCHEMA_VERSION + 1, str(SCHEMA_VERSION), None)]),
    *((name, [without(name)]) for name in ("graphs", "files", "runtime", "model", "provenance", "target")),
    ("last_layer_kv", [with_runtime(kv_dim=128)]),
    (
        "runtime",
        [
            with_runtime(tick_period_ms=0), with_runtime(frame_offsets_s=[]), with_runtime(frame_offsets_s=[1e5]),
            with_runtime(control_cores=3), with_runtime(reasoning_cores=[-1]), with_runtime(max_context=0),
            with_runtime(control_priority=60), with_runtime(control_priority=100),  # 60 is the bridge's
            with_runtime(max_new_tokens=-1), with_runtime(step_s="0.1"), with_runtime(image_px=True),
            with_runtime(max_new_tokens=48.5),
        ],
    ),
    ("step_s 999999, expected 0.02 to 0.5", [with_runtime(step_s=999_999)]),
    ("step_s is 0.2, the network was built for 0.1", [with_runtime(step_s=0.2)]),
    ("tick_period_ms .*, expected 20 to 150", [with_runtime(tick_period_ms=period_ms) for period_ms in (1, 151)]),
    ("tick_period_ms is 150, the plan's is 100", [with_runtime(tick_period_ms=150)]),
    ("must grow by a tick of 0.1 s", [with_runtime(frame_offsets_s=offsets) for offsets in ([0, 0.001], [3, 0])]),
    ("max_context 128 is too short: 4 frames of 16 tokens, text and an answer", [with_runtime(max_context=128)]),
    ("expected different cores from 0 to 1023", [with_runtime(control_cores=cores) for cores in ([9999], [1, 1])]),
    ("core 90 is used, the target has the cores", [with_runtime(reasoning_cores=[90])]),
    ("in control_cores and in reasoning_cores", [with_runtime(control_cores=[0], reasoning_cores=[0])]),
    ("special token ids .* are not distinct", [with_runtime(img_end_id=3)]),
    ("<img> is id 3, the network was built for 7", [with_runtime(img_start_id=7)]),
    ("nested deeper than 32 levels", [lambda m: m.update(plan=nested(40))]),
    ("bytes, expected at most", [lambda m: m["files"]["report.json"].update(bytes=10 << 30)]),
    ("bytes together, expected at most", [lambda m: m["files"].update({f"{n}.onnx": LARGE for n in range(5)})]),
    ("has a tensor of shape", [lambda m: m["graphs"]["vision_encoder"]["inputs"][0].update(shape=[1, 1 << 40])]),
    ("self_test: ", [
        lambda m: m["self_test"].pop("seed"), lambda m: m["self_test"].update(limit_s=1e9),
        lambda m: m["self_test"]["answers"].pop("chain"), lambda m: m.update(self_test=[]),
        lambda m: m["self_test"]["answers"]["chain"].update(tolerance=1.0),
        lambda m: m["self_test"]["answers"]["chain"].update(digest=[0.0] * 16),
        lambda m: m["self_test"]["answers"]["chain"].update(tokens=[-1]),
    ]),
    ("runtime has", [with_runtime(max_speed=9)]),
    (
        "expected.*constrained",
        [
            with_runtime(decoding="loose"), with_runtime(recovery=True), with_runtime(recovery=1),
            with_runtime(decoding=None),
        ],
    ),
    (
        "session",
        [with_session(s) for s in (None, {}, {"provider": 1, "options": {}, "threads": None, "engine": False})],
    ),
]  # fmt: skip


@pytest.mark.parametrize(("message", "change"), [(message, change) for message, edits in WRONG for change in edits])
def test_a_manifest_that_cannot_be_run_is_refused(copy: Path, message: str, change: Edit) -> None:
    edit_manifest(copy, change)
    with pytest.raises(ArtifactError, match=message):
        load_artifacts(copy)


@pytest.mark.parametrize(
    ("change", "switches"),
    [
        (
            lambda m: [m["runtime"].pop(key, None) for key in ("decoding", "recovery")],
            (Decoding.CONSTRAINED, RecoverySwitch.ON),
        ),
        (with_runtime(decoding="free", recovery="off"), (Decoding.FREE, RecoverySwitch.OFF)),
    ],
    ids=["a manifest from before the switches", "a manifest with switches"],
)
def test_a_manifest_has_defaults_of_the_switches(copy: Path, change: Edit, switches: tuple[object, object]) -> None:
    edit_manifest(copy, change)
    runtime = load_artifacts(copy).runtime
    assert (runtime.decoding, runtime.recovery) == switches


def test_an_older_export_is_refused_with_the_command_that_makes_it_again(nano_dir: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(nano_dir, tmp_path / "nano"))
    edit_manifest(copy, version(3))
    command = f"edge-export --target cpu --model nano --out {copy}"
    with pytest.raises(ArtifactError, match=f"schema version 3, expected {SCHEMA_VERSION}; .*: {command}$"):
        load_artifacts(copy)


def test_a_large_sparse_file_is_refused_without_reading_it(copy: Path) -> None:
    with (copy / "report.json").open("wb") as file:
        file.truncate(60 << 20)
    # Its size is that of the manifest, so only its hash tells; above the limit of its kind it is not even opened.
    entry = {"bytes": 60 << 20, "sha256": "0" * 64}
    edit_manifest(copy, lambda m: m["files"].update({"report.json": entry}))
    with pytest.raises(ArtifactError, match=r"report\.json: sha256"):
        load_artifacts(copy)
    edit_manifest(copy, lambda m: m["files"].update({"report.json": {**entry, "bytes": 10 << 30}}))
    (copy / "report.json").unlink()
    with pytest.raises(ArtifactError, match=r"report\.json has 10737418240 bytes, expected at most"):
        load_artifacts(copy)


def test_a_graph_that_differs_from_the_manifest_is_refused_when_opened(copy: Path) -> None:
    replace_file(copy, "action_expert.onnx", (copy / "semantic_context.onnx").read_bytes())
    with pytest.raises(ArtifactError, match="not those of the manifest"):
        Graph(load_artifacts(copy), "action_expert", threads=1)


def test_weights_outside_the_graph_cannot_be_reached(copy: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    proto = onnx.load(str(copy / "semantic_context.onnx"))
    onnx.external_data_helper.convert_model_to_external_data(proto, location="planted.bin", size_threshold=0)
    onnx.save(proto, str(copy.parent / "external.onnx"))
    replace_file(copy, "semantic_context.onnx", (copy.parent / "external.onnx").read_bytes())
    # The file is there, in the working directory, with weights of the right size.
    monkeypatch.chdir(copy.parent)
    assert Path("planted.bin").exists()
    with pytest.raises(ArtifactError, match=r"semantic_context\.onnx: weights in 'planted\.bin'"):
        load_artifacts(copy)


def test_an_invalid_tokenizer_is_refused(copy: Path) -> None:
    replace_file(copy, "tokenizer.json", b"{}")
    with pytest.raises(ArtifactError, match="not a tokenizer"):
        LanguageModel(load_artifacts(copy))


def test_a_graph_that_onnx_runtime_does_not_take_is_refused_when_opened(copy: Path) -> None:
    replace_file(copy, "action_expert.onnx", onnx.ModelProto(ir_version=10).SerializeToString())
    with pytest.raises(ArtifactError, match="cannot open"):
        Graph(load_artifacts(copy), "action_expert", threads=1)


@pytest.fixture(scope="module")
def mapped(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """`nano` with its encoder's weights in a data file, as large graphs have them."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("export.graphs.build.SINGLE_FILE_BYTES", 5_000_000)
        return write_artifacts(build(PRESETS["nano"], 0), tmp_path_factory.mktemp("mapped"))


@pytest.fixture
def mapped_copy(mapped: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(mapped, tmp_path / "mapped"))


DATA = "vision_encoder.onnx.data"


@pytest.mark.slow
def test_weights_in_a_data_file_compute_the_same(mapped: Path, tmp_path: Path) -> None:
    whole = write_artifacts(build(PRESETS["nano"], 0), tmp_path)
    assert (mapped / DATA).exists() and not (whole / DATA).exists()
    frame = np.random.default_rng(0).integers(0, 256, (1, 128, 128, 3)).astype(np.uint8)
    inside, outside = (Policy(load_artifacts(d)).encode(frame) for d in (whole, mapped))
    np.testing.assert_array_equal(inside, outside)


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


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (flip_bit, "sha256"),
        (lambda d, name: (d.parent / "second-name").hardlink_to(d / name), "has 2 names"),
        (link_to_outside, "missing or not a regular file"),
        (lambda d, name: edit_manifest(d, lambda m: m["files"].pop(name)), "not listed"),
    ],
    ids=["flipped bit", "second name", "symlink", "not listed"],
)
def test_a_damaged_data_file_is_refused(mapped_copy: Path, damage: Callable[[Path, str], object], message: str) -> None:
    damage(mapped_copy, DATA)
    with pytest.raises(ArtifactError, match=rf"{DATA}: {message}"):
        load_artifacts(mapped_copy)


def add_external(directory: Path, key: str, value: str, *, again: bool = False) -> None:
    """Set an entry of the encoder's first reference to external data, or give it again."""
    model = onnx.load(str(directory / "vision_encoder.onnx"), load_external_data=False)
    tensor = next(tensor for tensor in model.graph.initializer if tensor.external_data)
    entries = [entry for entry in tensor.external_data if entry.key == key and not again]
    entry = entries[0] if entries else tensor.external_data.add()
    entry.key, entry.value = key, value
    replace_file(directory, "vision_encoder.onnx", model.SerializeToString())


@pytest.mark.parametrize(
    ("key", "value", "message"),
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
    mapped_copy: Path, key: str, value: str, message: str
) -> None:
    add_external(mapped_copy, key, value)
    with pytest.raises(ArtifactError, match=rf"vision_encoder\.onnx: .*{message}"):
        load_artifacts(mapped_copy)


def test_external_data_given_twice_is_refused(mapped_copy: Path) -> None:
    add_external(mapped_copy, "location", "../outside.bin", again=True)
    with pytest.raises(ArtifactError, match="once each"):
        load_artifacts(mapped_copy)


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
    edit_manifest(copy, lambda m: m["graphs"]["vision_encoder"]["session"].update(provider=provider, options=options))
    with pytest.raises(ArtifactError, match=rf"vision_encoder: session option .*{next(iter(options))}"):
        load_artifacts(copy)


@pytest.mark.parametrize("target", ["cpu", "orin", "rtx4060"])
def test_the_session_options_of_the_shipped_targets_are_taken(target: str) -> None:
    for provider in load_target(target).providers.values():
        profile = {f"trt_profile_{kind}_shapes": "a.b:1x2,c:3x4" for kind in PROFILES} if provider.engine else {}
        assert wrong_option(provider.name, {**provider.options, **profile}) is None


def test_openvino_gets_its_precision_and_threads_in_its_own_form_and_others_what_the_manifest_has() -> None:
    options = load_target("cpu").providers["openvino"].options
    assert opened_with("OpenVINOExecutionProvider", options, 2) == {
        "device_type": "CPU",
        "num_streams": "1",
        "num_of_threads": "2",
        "load_config": '{"CPU": {"INFERENCE_PRECISION_HINT": "bf16"}}',
    }
    assert opened_with("CUDAExecutionProvider", {"use_tf32": "0"}, 2) == {"use_tf32": "0"}


def test_a_provider_that_this_machine_lacks_is_refused_by_name(copy: Path) -> None:
    edit_manifest(copy, lambda m: m["graphs"]["vision_encoder"]["session"].update(provider="QNNExecutionProvider"))
    with pytest.raises(ArtifactError, match="made for QNNExecutionProvider"):
        Graph(load_artifacts(copy), "vision_encoder", threads=1)
