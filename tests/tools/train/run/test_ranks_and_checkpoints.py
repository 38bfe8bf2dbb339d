"""Run folders, jobs, checkpoints, optimisers and ranks: what every stage of training stands on."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors import SafetensorError

from edge.core.cli import EXIT_BAD_INPUT, EXIT_INTERRUPTED
from export.model.config import PRESETS
from tools.train import cli
from tools.train.config.checks import OptimConfig, TrainError
from tools.train.config.recipe import load_recipe
from tools.train.run import loop
from tools.train.run.distributed import autocast, computes_bf16
from tools.train.run.loop import Optimiser, learning_rate, load_checkpoint, save_checkpoint, under, with_prefix
from tools.train.run.run_dir import RunDir

NANO = PRESETS["nano"]
ROOT = Path(__file__).parents[4]


# Run folders


def run_dir(tmp_path: Path, **changed: object) -> RunDir:
    return RunDir.open(tmp_path / "run", replace(load_recipe("tiny"), **changed))


@pytest.mark.slow
def test_a_run_records_its_versions(tmp_path: Path) -> None:
    made = run_dir(tmp_path)
    assert load_recipe(str(made.recipe_path)) == load_recipe("tiny")
    versions = json.loads((made.out / "versions.json").read_text())
    assert versions["packages"]["numpy"] == np.__version__ and versions["python"]


@pytest.mark.slow
def test_a_run_that_continues_with_other_code_reports_it_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = run_dir(tmp_path)
    first = json.loads((made.out / "versions.json").read_text())
    run_dir(tmp_path)
    assert json.loads((made.out / "versions.json").read_text()) == first
    assert not made.other_code()
    monkeypatch.setattr("tools.train.run.run_dir.code_sha256", lambda: "of tomorrow")
    for _ in range(2):
        run_dir(tmp_path)
    versions = json.loads((made.out / "versions.json").read_text())
    later = versions.pop("later")
    assert versions == first and [each["code_sha256"]["simulation"] for each in later] == ["of tomorrow"]
    assert made.other_code()


@pytest.mark.parametrize("text", ["[" * 100_000, "[]", "{", "\udcff"], ids=["deep", "list", "cut", "not UTF-8"])
@pytest.mark.parametrize("name", ["versions.json", "timings.json", "sft/result.json"])
def test_a_damaged_file_of_a_run_is_one_clear_line(name: str, text: str, tmp_path: Path) -> None:
    made = RunDir(tmp_path)
    (made.stage("sft").parent / name).write_text(text, encoding="utf-8", errors="surrogateescape")
    read = {"versions.json": made._note_versions, "timings.json": made.timings}.get(name, lambda: made.result("sft"))
    with pytest.raises(TrainError, match=f"{name}: expected a JSON object of edge-train") as caught:
        read()
    assert "\n" not in str(caught.value)


def test_timings_that_are_no_numbers_are_refused(tmp_path: Path) -> None:
    (tmp_path / "timings.json").write_text('{"sft": "long"}')
    with pytest.raises(TrainError, match=r"timings\.json: expected seconds by step"):
        RunDir(tmp_path).add_time("sft", 1.0)


def test_damaged_lines_of_the_log_are_left_out(tmp_path: Path) -> None:
    made = RunDir(tmp_path)
    made.log("sft", 1, loss=0.5)
    with made.log_path.open("ab") as file:
        file.write(b'{"stage": "\xff"}\n[]\n{}\n' + b"[" * 100_000 + b"\n")
    made.log("sft", 2, loss=0.25)
    assert [line["step"] for line in made.lines()] == [1, 2]


@pytest.mark.slow
def test_numbers_of_a_stage_may_change_until_it_has_begun(tmp_path: Path) -> None:
    made = run_dir(tmp_path)
    (made.stage("collect") / "drive").touch()
    later = load_recipe("tiny", ["sft.epochs=9"])
    assert load_recipe(str(RunDir.open(made.out, later).recipe_path)) == later
    (made.stage("sft") / "state").touch()
    with pytest.raises(TrainError, match=r"sft.epochs: found 9, recipe 8"):
        RunDir.open(made.out, load_recipe("tiny", ["sft.epochs=8"]))


@pytest.mark.slow
@pytest.mark.parametrize("setting", ["seed=5", "model.action.latency_aware=false"])
def test_seed_and_network_of_a_run_are_fixed_by_its_first_stage(setting: str, tmp_path: Path) -> None:
    made = run_dir(tmp_path)
    RunDir.open(made.out, load_recipe("tiny", [setting]))
    (made.stage("collect") / "drive").touch()
    with pytest.raises(TrainError, match="was started with another recipe"):
        RunDir.open(made.out, load_recipe("tiny"))


def test_a_foreign_folder_is_refused(tmp_path: Path) -> None:
    (tmp_path / "letters").mkdir()
    (tmp_path / "letters" / "to-mother.txt").touch()
    with pytest.raises(TrainError, match="new or empty directory"):
        RunDir.open(tmp_path / "letters", load_recipe("tiny"))


def test_a_resumed_stage_writes_its_lines_again_and_only_its_own(tmp_path: Path) -> None:
    made = run_dir(tmp_path)
    for step in (1, 2, 3):
        made.log("sft", step, loss=1.0 / step)
        made.log("imitate", step, loss=2.0)
    made.rewind("sft", 1)
    assert [(line["stage"], line["step"]) for line in made.lines()] == [
        ("sft", 1), ("imitate", 1), ("imitate", 2), ("imitate", 3),
    ]  # fmt: skip


def test_a_retired_stages_files_are_kept_under_another_name(tmp_path: Path) -> None:
    made = run_dir(tmp_path)
    made.finish("imitate", {"loss": 1.0})
    made.log("imitate", 1, loss=1.0)
    made.retire("imitate", "imitate-0")
    assert made.result("imitate") is None and made.result("imitate-0") == {"loss": 1.0}
    assert [line["stage"] for line in made.lines()] == ["imitate-0"]


@pytest.mark.slow
def test_another_runs_stages_are_used_where_they_would_be_the_same(tmp_path: Path) -> None:
    base = run_dir(tmp_path)
    for stage in ("collect", "encoder", "sft"):
        base.finish(stage, {"of": stage})
    recipe = load_recipe("tiny", ["model.action.latency_aware=false"])
    ablation = RunDir.open(tmp_path / "ablation", recipe)
    ablation.borrow(base, ("collect", "encoder", "sft"), recipe)
    assert ablation.result("sft") == {"of": "sft"} and ablation.borrowed("sft")
    for setting in ("sft.epochs=99", "model.language.mlp=64"):
        with pytest.raises(TrainError, match="--from"):
            RunDir(tmp_path / "x").borrow(base, ("sft",), load_recipe("tiny", [setting]))


# Jobs


# Checkpoints


def learn(steps: int, path: Path | None = None, stop_at: int | None = None) -> tuple[torch.Tensor, list[float]]:
    """Weights and losses of a small training with dropout, stopped into `path` at a step or gone on from there."""
    model = torch.nn.Linear(6, 3)
    torch.nn.init.constant_(model.weight, 0.1)
    torch.nn.init.zeros_(model.bias)
    optimiser = Optimiser(model.parameters(), OptimConfig(lr=0.01, warmup_steps=5), 20)
    generator, rng = torch.Generator().manual_seed(3), np.random.default_rng(3)
    if path is not None and stop_at is None:
        tensors, meta = load_checkpoint(path)
        model.load_state_dict(under("model", tensors))
        optimiser.restore(under("optimiser", tensors))
        generator.set_state(tensors["generator"])
        rng.bit_generator.state = meta["rng"]
    losses = []
    while optimiser.step_count < (steps if stop_at is None else stop_at):
        x = torch.randn(8, 6, generator=generator) * float(rng.uniform(0.5, 1.5))
        loss = (model(x) - 1).pow(2).mean()
        loss.backward()
        optimiser.step()
        losses.append(float(loss.detach()))
    if path is not None and stop_at is not None:
        tensors = {
            **with_prefix("model", model.state_dict()),
            **with_prefix("optimiser", optimiser.tensors()),
            "generator": generator.get_state(),
        }
        save_checkpoint(path, tensors, {"rng": dict(rng.bit_generator.state)})
    return model.weight.detach().clone(), losses


def test_training_that_was_stopped_goes_on_bit_for_bit(tmp_path: Path) -> None:
    whole, losses = learn(20)
    path = tmp_path / "checkpoint.safetensors"
    _, first = learn(20, path, stop_at=7)
    resumed, rest = learn(20, path)
    assert torch.equal(whole, resumed) and first + rest == losses


def test_a_checkpoint_holds_tensors_of_every_kind_and_tied_ones(tmp_path: Path) -> None:
    shared = torch.arange(6.0)
    tensors = {"a": shared, "b": shared, "half": torch.ones(2, dtype=torch.bfloat16), "count": torch.tensor(3)}
    save_checkpoint(tmp_path / "c", tensors, {"epoch": 2, "words": ["x"]})
    read, meta = load_checkpoint(tmp_path / "c")
    assert meta == {"epoch": 2, "words": ["x"]}
    assert all(torch.equal(read[name], tensor) and read[name].dtype == tensor.dtype for name, tensor in tensors.items())


def test_a_checkpoint_that_cannot_be_written_leaves_the_one_before(tmp_path: Path) -> None:
    path = tmp_path / "c"
    save_checkpoint(path, {"a": torch.ones(1)}, {})
    with pytest.raises(TypeError):
        save_checkpoint(path, {"a": torch.zeros(1)}, {"no JSON": object()})
    assert load_checkpoint(path)[0]["a"] == 1 and list(tmp_path.iterdir()) == [path]


def test_a_full_disk_is_an_os_error_and_leaves_the_checkpoint_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "c"
    save_checkpoint(path, {"a": torch.ones(1)}, {})

    def full(*_: object, **__: object) -> None:
        raise SafetensorError("Error while serializing: I/O error: No space left on device (os error 28)")

    monkeypatch.setattr(loop, "save_file", full)
    with pytest.raises(OSError, match=f"No space left on device.*{path}"):
        save_checkpoint(path, {"a": torch.zeros(1)}, {})
    assert load_checkpoint(path)[0]["a"] == 1 and list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("content", [b"", b"\x00" * 40, b"not tensors at all"])
def test_a_damaged_checkpoint_is_one_clear_line(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "c"
    path.write_bytes(content)
    with pytest.raises(TrainError, match="delete it to start again") as caught:
        load_checkpoint(path)
    assert "\n" not in str(caught.value)


# Optimisers


def test_the_learning_rate_warms_up_and_falls_like_a_cosine() -> None:
    config = OptimConfig(lr=1.0 - 1e-9, warmup_steps=10, final_lr_share=0.1)
    rates = [learning_rate(config, step, 110) for step in range(110)]
    assert rates[0] == pytest.approx(0.1) and max(rates) == pytest.approx(1.0) and rates[10] == pytest.approx(1.0)
    assert rates[60] == pytest.approx(0.55) and rates[-1] == pytest.approx(0.1, abs=1e-3)


@pytest.mark.parametrize(
    ("has", "kind"),
    [({"avx2": True}, torch.float32), ({"avx512_bf16": True}, torch.bfloat16), ({"amx_bf16": True}, torch.bfloat16)],
)
def test_a_processor_computes_in_bfloat16_only_with_instructions_for_it(
    has: dict[str, bool], kind: torch.dtype, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: has)
    computes_bf16.cache_clear()
    try:
        with autocast("cpu", bf16=True):
            assert torch.nn.functional.linear(torch.ones(1, 2), torch.ones(1, 2)).dtype is kind
        assert computes_bf16("cuda")
    finally:
        computes_bf16.cache_clear()


@pytest.mark.parametrize(("device", "inside"), [("cpu", "error"), ("cuda", "default")])
def test_operations_are_deterministic_on_the_cpu_until_the_command_ends(device: str, inside: str) -> None:
    modes = {"default": 0, "error": 2}
    with pytest.raises(KeyboardInterrupt), cli.deterministic(device):
        assert torch.get_deterministic_debug_mode() == modes[inside]
        raise KeyboardInterrupt
    assert torch.get_deterministic_debug_mode() == modes["default"]


def test_a_step_that_is_not_finite_changes_nothing_and_is_counted() -> None:
    weight = torch.nn.Parameter(torch.ones(2, 2))
    optimiser = Optimiser([weight], OptimConfig(), 10)
    weight.grad = torch.full((2, 2), float("nan"))
    assert np.isnan(optimiser.step()) and torch.equal(weight, torch.ones(2, 2)) and optimiser.step_count == 1


def test_gains_and_biases_do_not_decay() -> None:
    gain, weight = torch.nn.Parameter(torch.ones(3)), torch.nn.Parameter(torch.ones(3, 3))
    optimiser = Optimiser([gain, weight], OptimConfig(lr=0.1, weight_decay=0.5, warmup_steps=0), 10)
    for each in (gain, weight):
        each.grad = torch.zeros_like(each)
    optimiser.step()
    assert torch.equal(gain, torch.ones(3)) and float(weight.detach().max()) < 1


# Ranks


def two_ranks(module: str, *arguments: str) -> list[tuple[int, str]]:
    """Exit codes and standard errors of a module that is run as torchrun runs it, in two processes."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    ranks = []
    for rank in range(2):
        env = {**os.environ, "RANK": str(rank), "WORLD_SIZE": "2", "LOCAL_RANK": str(rank), "LOCAL_WORLD_SIZE": "2",
               "OMP_NUM_THREADS": "1", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port),
               "PYTHONPATH": str(ROOT)}  # fmt: skip
        command = [sys.executable, "-m", module, *arguments]
        ranks.append(subprocess.Popen(command, env=env, cwd=ROOT, stderr=subprocess.PIPE, text=True))
    try:
        said = [process.communicate(timeout=120)[1] for process in ranks]
    finally:
        for process in ranks:
            process.kill()
    sys.stderr.writelines(said)  # shown where a test fails
    return [(process.returncode, text) for process, text in zip(ranks, said, strict=True)]


def codes(ended: list[tuple[int, str]]) -> list[int]:
    return [code for code, _ in ended]


@pytest.mark.slow
def test_two_processes_share_the_stages_that_can_be_shared_and_the_first_does_the_others_alone(tmp_path: Path) -> None:
    assert codes(two_ranks("tests.support.train.train_chain_rank", str(tmp_path), "done")) == [0, 0]
    steps = ["collect", "encoder", "sft", "imitate", "dagger", "sft", "imitate", "rl", "evaluate"]
    shared = {"encoder", "sft", "imitate"}
    done = [(tmp_path / f"{rank}.txt").read_text().splitlines() for rank in range(2)]
    # A rank that works alone has the threads of both ranks.
    assert done[0] == [f"{step} 0/2 1" if step in shared else f"{step} 0/1 2" for step in steps]
    assert done[1] == [f"{step} 1/2 1" for step in steps if step in shared]
    assert (tmp_path / "run" / "imitate-0").is_dir() and (tmp_path / "run" / "evaluate" / "result.json").is_file()


@pytest.mark.slow
def test_processes_stop_together_on_one_request_and_go_on_together(tmp_path: Path) -> None:
    stopped = two_ranks("tests.support.train.train_chain_rank", str(tmp_path), "stop")
    assert codes(stopped) == [EXIT_INTERRUPTED] * 2
    assert ["interrupted, finished work is kept" in text for _, text in stopped] == [True, False]
    before = [(tmp_path / f"{rank}.txt").read_text().split() for rank in range(2)]
    assert before[0][-3] == before[1][-3] == "encoder"
    ended = two_ranks("tests.support.train.train_chain_rank", str(tmp_path), "done")
    assert codes(ended) == [0, 0] and "encoder: done before" in ended[0][1]
    assert (tmp_path / "1.txt").read_text().split().count("encoder") == 1


@pytest.mark.slow
@pytest.mark.parametrize("failing", ["collect", "dagger", "set-up"])
def test_where_the_first_process_fails_at_its_own_work_the_others_end_with_it(tmp_path: Path, failing: str) -> None:
    line = f"{failing} has failed"
    if failing == "set-up":
        other = RunDir.open(tmp_path / "run", load_recipe("tiny", ["seed=5"]))
        (other.stage("collect") / "begun").touch()
        line = "started with another recipe (seed: found 5, recipe 1)"
    (code, said), (others, heard) = two_ranks("tests.support.train.train_chain_rank", str(tmp_path), failing)
    assert (code, others) == (EXIT_BAD_INPUT, EXIT_BAD_INPUT)
    assert line in said and "edge-train: the first process has ended early" in heard
    assert "Traceback" not in said + heard


@pytest.mark.slow
def test_run_as_a_module_it_reports_an_error_in_one_line() -> None:
    command = [sys.executable, "-m", "tools.train.cli", "all", "--preset", "nope", "--out", "never"]
    ended = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120, check=False)
    assert ended.returncode == EXIT_BAD_INPUT
    assert "edge-train: --preset nope: expected one of" in ended.stderr and "Traceback" not in ended.stderr


def test_weights_are_no_checkpoint(tmp_path: Path) -> None:
    from safetensors.torch import save_file

    save_file({"a": torch.ones(1)}, str(tmp_path / "c"))
    with pytest.raises(TrainError, match="expected format"):
        load_checkpoint(tmp_path / "c")


@pytest.mark.slow
def test_a_stage_that_has_not_finished_is_not_lent(tmp_path: Path) -> None:
    base = run_dir(tmp_path)
    with pytest.raises(TrainError, match="sft has not finished"):
        RunDir(tmp_path / "x").borrow(base, ("sft",), load_recipe("tiny"))
