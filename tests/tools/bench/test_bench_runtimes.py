"""The comparison of runtimes: its arithmetic, its protocol with workers, and how it refuses. No timing is asserted."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest

from tools.bench import runtimes
from tools.bench.peers.contenders import (
    CONTENDERS,
    OURS,
    Metric,
    chosen,
    judge,
    judge_all,
    markdown,
    paired_ratio,
    verdict_text,
)
from tools.bench.peers.models import prepare
from tools.bench.peers.models.reference import qwen_name
from tools.bench.peers.rounds import FOREIGN_CORES, MemoryWatch, Round, Sample, Worker, WorkerError, busy_s, run_rounds
from tools.bench.peers.workers.serve import Load

FASTER = Metric("x_ms", "x", "ms", False, 1.5)
MORE = Metric("x_tokens_per_s", "x", "tok/s", True, 1.8)
STACKS = {"mine": OURS, "ov": "openvino", "llama": "llama", "genai": "genai", "plain": "onnxruntime"}
LOAD = {"load": {"model": "nano", "cache": ".", "threads": 1, "parts": ["encoder"], "options": {}}}


def worker(mood: str, tmp_path: Path) -> Worker:
    command = [sys.executable, "-m", "tests.support.benchmark.fake_worker", mood]
    return Worker(mood, command, frozenset(sorted(os.sched_getaffinity(0))[:1]), tmp_path / f"{mood}.log")


# Arithmetic


def test_a_ratio_is_the_median_of_the_pairs_not_the_ratio_of_medians() -> None:
    assert paired_ratio(FASTER, [10.0, 30.0, 10.0], [20.0, 60.0, 50.0]) == 2.0


def test_our_own_stack_is_listed_but_is_not_the_peer_of_a_bar() -> None:
    verdict = judge(MORE, {"mine": [38.0], "genai": [30.0], "ov": [20.0]}, STACKS)
    assert (verdict.best_peer, verdict.ratio, verdict.reached) == ("ov", 1.9, True)
    assert "genai" in [row.contender for row in verdict.rows]


def test_a_missed_bar_is_reported() -> None:
    verdict = judge(FASTER, {"mine": [10.0], "ov": [14.0]}, STACKS)
    assert verdict.reached is False
    assert "NOT reached" in verdict_text(verdict)


@pytest.mark.parametrize("series", [{"ov": [1.0]}, {"mine": [1.0]}, {"mine": [1.0], "genai": [1.0]}])
def test_without_ours_or_a_peer_nothing_is_claimed(series: dict[str, list[float]]) -> None:
    verdict = judge(MORE, series, STACKS)
    assert (verdict.ratio, verdict.reached) == (None, None)
    assert verdict_text(verdict) == "not compared"


def test_the_summary_names_every_contender_and_every_verdict() -> None:
    series = {"prefill_ms": {"mine": [10.0, 12.0], "ov": [20.0, 24.0], "genai": [9.0, 9.0]}}
    text = markdown(judge_all(series, STACKS), "Compared", ["a note"])
    for expected in ("a note", "| **mine** | 11 | 10 | 12 | 2 |", "genai (our own stack)", "2.00× against ov"):
        assert expected in text


# Who takes part


def test_contenders_have_names_of_their_own_and_assets_that_can_be_made() -> None:
    assert len({c.name for c in CONTENDERS}) == len(CONTENDERS)
    assert {asset for c in CONTENDERS for asset in c.assets} <= {"reference", *prepare.ASSETS}


def test_only_picks_by_name_and_refuses_an_unknown_name() -> None:
    assert {c.stack for c in chosen(["llama*"])} == {"llama"}
    with pytest.raises(ValueError, match="no contender of that name; there are: ours control"):
        chosen(["tensorrt*"])


def test_every_tensor_of_our_language_model_has_a_name_in_a_qwen2_checkpoint() -> None:
    assert qwen_name("layers.3.q.bias") == "model.layers.3.self_attn.q_proj.bias"
    assert qwen_name("layers.0.mlp_norm.weight") == "model.layers.0.post_attention_layernorm.weight"
    assert qwen_name("embed.weight") == "model.embed_tokens.weight"
    assert qwen_name("lm_head.weight") == "lm_head.weight"


# Protocol


def test_a_worker_answers_although_its_libraries_talk_on_standard_output(tmp_path: Path) -> None:
    with worker("ok", tmp_path) as w:
        assert set(w.ask(LOAD)["tasks"]) == {"encoder", "language", "slow"}
        answer = w.ask({"run": "encoder", "calls": 3})
        assert answer["values"] == {"encoder_ms": [5.0, 5.0, 5.0]}
        values = w.ask({"run": "language", "calls": 1})["values"]
        assert set(values) == {"prefill_ms", "decode_tokens_per_s", "generation_ms"}
    assert "a library talks" in (tmp_path / "ok.log").read_text()


def test_a_worker_runs_on_the_cores_it_is_given(tmp_path: Path) -> None:
    with worker("ok", tmp_path) as w:
        w.ask(LOAD)
        assert os.sched_getaffinity(w.pid) == w.cores


def test_a_refusal_is_one_line_with_the_place_of_the_log(tmp_path: Path) -> None:
    with worker("refuses", tmp_path) as w, pytest.raises(WorkerError) as caught:
        w.ask(LOAD)
    assert str(caught.value) == f"refuses: ValueError: no such form; its log: {tmp_path / 'refuses.log'}"


def test_a_worker_that_dies_is_an_error_not_a_hang(tmp_path: Path) -> None:
    with worker("dies", tmp_path) as w:
        w.ask(LOAD)
        with pytest.raises(WorkerError, match="ended with code 3"):
            w.ask({"run": "encoder", "calls": 1})


def test_peak_memory_sees_what_a_worker_holds(tmp_path: Path) -> None:
    peaks = {}
    for mood in ("ok", "large"):
        with worker(mood, tmp_path) as w, MemoryWatch(w.pid) as watch:
            w.ask(LOAD)
            peaks[mood] = watch.peak()
    assert 60 < peaks["large"].anon_mb - peaks["ok"].anon_mb < 70
    assert all(peak.rss_mb >= peak.pss_mb > 0 and peak.rss_mb >= peak.anon_mb for peak in peaks.values())


def test_unknown_fields_in_a_request_are_refused() -> None:
    with pytest.raises(ValueError, match="unexpected fields"):
        Load.from_dict({**LOAD["load"], "colour": "red"})


# Rounds


def round_of(group: str, *foreign: float) -> Round:
    samples = tuple(Sample("a", "encoder", {"encoder_ms": 1.0}, 1.0, 1.0, f, {}) for f in foreign)
    return Round(group, 0, (0.0, 0.0, 0.0), 0.0, samples)


def test_a_round_is_quiet_only_when_every_sample_was() -> None:
    assert round_of("control", 0.0, FOREIGN_CORES).quiet
    assert not round_of("control", 0.0, FOREIGN_CORES + 0.01).quiet


def test_time_that_the_host_stole_counts_as_foreign() -> None:
    tick = 1 / os.sysconf("SC_CLK_TCK")
    stat = "cpu  10 20 30 1000 500 1 2 4 0 0\ncpu0 1 1 1 1 1 1 1 1 0 0\n"
    assert busy_s(stat) == pytest.approx(67 * tick)


@pytest.mark.slow
def test_in_each_round_every_contender_runs_once_and_the_order_rotates(tmp_path: Path) -> None:
    with worker("ok", tmp_path) as a, worker("large", tmp_path) as b:
        for w in (a, b):
            w.ask(LOAD)
        field = {w.name: (w, ["encoder"]) for w in (a, b)}
        rounds = list(run_rounds("control", field, 1, 0.0, lambda name, reason: pytest.fail(reason)))
    orders = [[s.contender for s in r.samples] for r in rounds]
    assert orders[0] == ["ok", "large"] and 1 <= len(rounds) <= 2
    assert orders[1:] in ([], [["large", "ok"]])


@pytest.mark.slow
def test_a_contender_that_fails_leaves_the_field_and_the_others_go_on(tmp_path: Path) -> None:
    lost: list[str] = []
    with worker("ok", tmp_path) as a, worker("fails-later", tmp_path) as b:
        for w in (a, b):
            w.ask(LOAD)
        field = {w.name: (w, ["encoder"]) for w in (a, b)}
        rounds = list(run_rounds("control", field, 1, 0.0, lambda name, reason: lost.append(name)))
    assert lost == ["fails-later"]
    assert all([s.contender for s in r.samples] == ["ok"] for r in rounds)


# Preparation


def test_a_stamped_asset_is_not_made_again(tmp_path: Path) -> None:
    made: list[Path] = []
    folder = tmp_path / "asset"
    for content in ({"recipe": 1}, {"recipe": 1}, {"recipe": 2}):
        prepare.make(folder, content, made.append)
    assert len(made) == 2


def test_a_conversion_that_fails_leaves_no_stamp(tmp_path: Path) -> None:
    def fail(folder: Path) -> None:
        raise RuntimeError("no")

    with pytest.raises(RuntimeError):
        prepare.make(tmp_path / "asset", {"recipe": 1}, fail)
    assert not (tmp_path / "asset").exists()


# Command line


def test_without_the_peers_it_says_which_script_installs_them(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    venv = tmp_path / "none"
    assert runtimes.main(["--model", "nano", "--out", str(tmp_path / "out"), "--peers-venv", str(venv)]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert lines == [f"{venv}: no environment of the peers; make it with: tools/bench/peers/install.sh {venv}"]


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--repeats", "0"], "--repeats must be positive"),
        (["--threads", "4096"], "--threads 1 to"),
        (["--model", "2b"], "expected one of: 1b, nano"),
        (["--only", "nobody"], "no contender of that name"),
        (["--artifacts", "nowhere"], "nowhere: not a directory"),
    ],
)
def test_bad_input_is_refused_in_one_line(
    flags: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert runtimes.main(["--out", str(tmp_path / "out"), *flags]) == 2
    text = capsys.readouterr().err
    assert message in text and text.count("\n") == 1


@pytest.mark.slow
def test_ours_alone_needs_no_environment_of_peers(
    tmp_path: Path, artifacts_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tools.bench.peers.rounds.FOREIGN_CORES", 1e9)  # other tests run beside this one
    out = tmp_path / "out"
    command = ["--artifacts", str(artifacts_dir), "--out", str(out), "--only", "ours*", "--threads", "1"]
    assert runtimes.main([*command, "--repeats", "1", "--quiet-wait-s", "0"]) == 0
    text = (out / "summary.md").read_text()
    assert "ours control" in text and "not compared" in text and (out / "samples.json").is_file()
