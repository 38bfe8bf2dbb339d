"""Compares a full-size InternVL3-1B in `transformers` with this project's import, in PyTorch and as fp32 graphs.

    python -m tools.bench.parity_1b --json out/bench/parity_1b.json

The weights are random (no checkpoint is downloaded) and bf16, saved by `save_pretrained`. Each network runs in a
separate process, one after the other, on the same prompt: frames, instruction, greedy answer.
The last-layer keys and values compared are those of the prompt. Exit code 1 when a bound is missed, 2 for bad input.
"""

from __future__ import annotations

import multiprocessing
import resource
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from rich.console import Console
from rich.table import Table
from tokenizers import Tokenizer

from edge.core.cli import EXIT_CHECK_FAILED, EXIT_DONE, check_result_target, command_line, write_result
from edge.core.geometry import SE2
from edge.reasoning.prompt import EXAMPLE_BEFORE, EXAMPLE_PAST_PATH, PromptBuilder, PromptIds
from edge.state.ring import EncodedFrame
from export.checkpoint.load import load_checkpoint
from export.checkpoint.tokenizer import tokenizer_for
from export.evaluation.task_error import cosine
from export.graphs.build import write_graph
from export.graphs.language import cache_names
from export.model.config import TicVlaConfig, config_for
from export.quantize.precision import Precision
from tools.bench import bad_input, command_parser

Arrays = dict[str, npt.NDArray[Any]]

COSINE, MAX_ABS = 0.99999, 1e-3
LOGIT_POSITIONS = 64
"""Number of positions at the prompt's end whose logits are compared: all would take 0.7 GB per network."""
INSTRUCTION = "walk down the corridor, pass the vending machine and stop at the second door on the left"
GRAPHS = ("vision_encoder", "language_model")


@dataclass(frozen=True)
class Work:
    """Arguments of every process."""

    directory: Path
    model: str
    frames: int
    new_tokens: int
    seed: int
    threads: int

    @property
    def config(self) -> TicVlaConfig:
        """Configuration of the network."""
        return config_for(self.model)

    def prompt(self) -> tuple[npt.NDArray[np.uint8], list[int]]:
        """Build frames [F, px, px, 3] with edges and noise, and the ids of the runner's prompt."""
        config, rng = self.config, np.random.default_rng(self.seed)
        px = config.vision.image_px
        coarse = rng.integers(0, 256, (self.frames, 8, 8, 3))
        repeat = -(-px // 8)
        frames = coarse.repeat(repeat, axis=1).repeat(repeat, axis=2)[:, :px, :px]
        noisy = np.clip(frames + rng.integers(-20, 21, frames.shape), 0, 255).astype(np.uint8)
        c = config.language
        ids = PromptIds(c.im_start_id, c.im_end_id, c.img_start_id, c.img_end_id, c.img_context_id)
        builder = PromptBuilder(Tokenizer.from_buffer(tokenizer_for(config, None)), ids, config.frame_tokens)
        nothing = np.zeros((1, 1, 1), dtype=np.float32)
        encoded = [EncodedFrame(i, SE2(0.3 * i, 0.0, 0.0), nothing) for i in range(self.frames)]
        return noisy, [
            i for segment in builder.build(encoded, INSTRUCTION, EXAMPLE_PAST_PATH, EXAMPLE_BEFORE) for i in segment.ids
        ]


def internvl_config(network: TicVlaConfig, *, tied: bool = False) -> Any:
    """Return the transformers configuration of the network."""
    from transformers import InternVLConfig

    v, c = network.vision, network.language
    return InternVLConfig(
        vision_config={
            "hidden_size": v.hidden,
            "num_hidden_layers": v.layers,
            "num_attention_heads": v.heads,
            "intermediate_size": v.mlp,
            "image_size": [v.image_px, v.image_px],
            "patch_size": [v.patch_px, v.patch_px],
            "attention_bias": True,
            "use_absolute_position_embeddings": True,
        },
        text_config={
            "model_type": "qwen2",
            "hidden_size": c.hidden,
            "num_hidden_layers": c.layers,
            "num_attention_heads": c.heads,
            "num_key_value_heads": c.kv_heads,
            "intermediate_size": c.mlp,
            "vocab_size": c.vocab,
            "rope_parameters": {"rope_theta": c.rope_theta, "rope_type": "dynamic", "factor": 2.0},
            "tie_word_embeddings": tied,
        },
        image_token_id=c.img_context_id,
        image_seq_length=v.tokens,
        tie_word_embeddings=tied,
    )


def hugging_face(work: Work) -> Arrays:
    """Write the checkpoint, then compute all outputs with transformers in fp32."""
    from transformers import InternVLForConditionalGeneration

    v = work.config.vision
    config = internvl_config(work.config)
    torch.manual_seed(work.seed)
    model = InternVLForConditionalGeneration(config).eval()
    with torch.no_grad():
        for name, parameter in model.named_parameters():
            # With transformers' initial values layers have little effect, biases are zero, the text repeats one word.
            if parameter.ndim == 1:
                parameter.normal_(1.0 if "norm" in name and name.endswith("weight") else 0.0, 0.1)
            else:
                parameter.normal_(0.0, 1.0 if "embed_tokens" in name else parameter[0].numel() ** -0.5)
            # Parameters only: the buffer of rotary frequencies is fp32 in every real run.
            parameter.data = parameter.data.bfloat16()
        model.save_pretrained(work.directory / "checkpoint")
        for parameter in model.parameters():
            parameter.data = parameter.data.float()
    frames, ids = work.prompt()
    mean, std = torch.tensor(v.mean), torch.tensor(v.std)
    pixels = ((torch.from_numpy(frames).float() / 255 - mean) / std).permute(0, 3, 1, 2)
    input_ids = torch.tensor([ids])
    visual = model.get_image_features(pixel_values=pixels).pooler_output
    out = model(input_ids=input_ids, pixel_values=pixels, use_cache=True, logits_to_keep=LOGIT_POSITIONS)
    layer = out.past_key_values.layers[-1]
    kv = torch.cat([x.transpose(1, 2).flatten(2) for x in (layer.keys, layer.values)], dim=-1)
    text = model.generate(
        input_ids=input_ids,
        attention_mask=torch.ones_like(input_ids),
        pixel_values=pixels,
        do_sample=False,
        max_new_tokens=work.new_tokens,
        pad_token_id=0,
    )[0, len(ids) :]
    return {
        "visual_tokens": visual.numpy(),
        "logits": out.logits[0].numpy(),
        "last_layer_kv": kv.numpy(),
        "text": text.numpy(),
    }


def ours_in_torch(work: Work) -> Arrays:
    """Import the checkpoint, write its graphs for `ours_as_graphs`, and compute all outputs in PyTorch."""
    model = load_checkpoint([work.directory / "checkpoint"], work.config, fill_seed=0).model
    for name in GRAPHS:
        write_graph(model, name, Precision("fp32"), "fused", work.directory)
    c = work.config.language
    frames, ids = work.prompt()
    visual = model.vision(torch.from_numpy(frames))
    past = [torch.zeros(1, c.kv_heads, 0, c.head_dim) for _ in range(2 * c.layers)]
    x, past, kv = model.language.hidden_states(torch.tensor([ids]), visual, past)
    logits = model.language.lm_head(x[0, -LOGIT_POSITIONS:])
    next_token, text = logits[-1].argmax(), []
    while True:
        text.append(int(next_token))
        if len(text) == work.new_tokens:
            break
        next_token, _, _, *past = model.language(next_token.reshape(1, 1), visual, past)
    return {
        "visual_tokens": visual.numpy(),
        "logits": logits.numpy(),
        "last_layer_kv": kv.numpy(),
        "text": np.array(text),
    }


def ours_as_graphs(work: Work) -> Arrays:
    """Compute the outputs with ONNX Runtime; a graph returns the logits of its last positions only."""
    import onnxruntime as ort

    options = ort.SessionOptions()
    options.intra_op_num_threads = work.threads
    c = work.config.language
    frames, ids = work.prompt()

    def session(name: str) -> ort.InferenceSession:
        return ort.InferenceSession(str(work.directory / f"{name}.onnx"), options, providers=["CPUExecutionProvider"])

    encoder = session("vision_encoder")
    visual = np.concatenate([encoder.run(["visual_tokens"], {"frame": frame[None]})[0] for frame in frames])
    del encoder
    language = session("language_model")
    shape = (1, c.kv_heads, len(ids) + work.new_tokens, c.head_dim)
    buffers = [np.zeros(shape, dtype=np.float32) for _ in range(2 * c.layers)]
    names = ["next_token", "logits", "last_layer_kv", *cache_names(c.layers, "present")]
    feed, total = ids, 0
    text: list[int] = []
    prompt: dict[str, npt.NDArray[Any]] = {}
    while len(text) < work.new_tokens:
        total += len(feed)
        feeds = {
            "input_ids": np.array([feed]),
            "visual_tokens": visual,
            "image_offset": np.array([0]),
            "seqlens_k": np.array([total - 1], dtype=np.int32),
            "total_sequence_length": np.array(total, dtype=np.int32),
            **dict(zip(cache_names(c.layers, "past_key_values"), buffers, strict=True)),
        }
        next_token, logits, kv, *buffers = language.run(names, feeds)
        prompt = prompt or {"logits": logits, "last_layer_kv": kv}
        feed = [int(next_token[0, -1])]
        text += feed
    return {"visual_tokens": visual, **prompt, "text": np.array(text)}


STAGES: dict[str, Callable[[Work], Arrays]] = {
    "transformers": hugging_face,
    "network": ours_in_torch,
    "graphs": ours_as_graphs,
}


def run_stage(name: str, work: Work) -> None:
    """Compute in this process and write arrays, time and peak memory to the working directory."""
    torch.set_num_threads(work.threads)
    started_ns = time.monotonic_ns()
    with torch.no_grad():
        arrays = STAGES[name](work)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    wall_s = (time.monotonic_ns() - started_ns) / 1e9
    np.savez(work.directory / f"{name}.npz", _peak_rss_bytes=peak, _wall_s=wall_s, allow_pickle=False, **arrays)


def in_own_process(name: str, work: Work) -> dict[str, npt.NDArray[Any]]:
    """Run `run_stage` in a new process, so that only one network is in memory. Raises RuntimeError."""
    process = multiprocessing.get_context("spawn").Process(target=run_stage, args=(name, work))
    process.start()
    process.join()
    if process.exitcode:
        raise RuntimeError(f"{name}: its process ended with code {process.exitcode}")
    with np.load(work.directory / f"{name}.npz", allow_pickle=False) as file:
        return dict(file)


def compare(theirs: Arrays, ours: Arrays) -> dict[str, Any]:
    """Compute every measure with its bound and whether it holds."""
    rows: dict[str, Any] = {}
    for name in ("visual_tokens", "last_layer_kv", "logits"):
        a, b = theirs[name], ours[name]
        a = a[-len(b) :] if name == "logits" else a
        worst = min(cosine(x, y) for x, y in zip(a, b, strict=True))
        largest = float(np.abs(a - b).max())
        rows[f"{name} cosine"] = {"value": worst, "bound": COSINE, "kept": worst >= COSINE}
        rows[f"{name} max-abs"] = {"value": largest, "bound": MAX_ABS, "kept": largest <= MAX_ABS}
        rows[f"{name} rms"] = {"value": float(np.sqrt(np.mean(np.square(a, dtype=np.float64))))}
    count = len(theirs["text"])
    same = int(np.cumprod(theirs["text"] == ours["text"]).sum())
    rows["greedy tokens identical"] = {"value": same, "bound": count, "kept": same == count}
    rows["different tokens in the text"] = {"value": len(set(theirs["text"].tolist()))}
    return rows


def show(result: dict[str, Any]) -> None:
    """Print the result as a table."""
    networks = result["compared"]
    table = Table(title=f"{result['model']} against transformers {result['transformers']}")
    for heading in ("", "bound", *networks):
        table.add_column(heading, justify="left" if not heading else "right")
    for measure, first in next(iter(networks.values())).items():
        cells = [f"{rows[measure]['value']:.8g}" for rows in networks.values()]
        kept = [rows[measure].get("kept", True) for rows in networks.values()]
        marked = [cell if ok else f"[bold red]{cell}" for cell, ok in zip(cells, kept, strict=True)]
        table.add_row(measure, f"{first['bound']:g}" if "bound" in first else "", *marked)
    for key, unit in (("wall_s", "s"), ("peak_rss_bytes", "bytes")):
        theirs = result["processes"]["transformers"][key]
        ours = [f"{result['processes'][name][key]:.8g}" for name in networks]
        table.add_row(f"{key} (transformers {theirs:.8g} {unit})", "", *ours)
    Console().print(table)


@command_line("parity_1b")
def main(argv: list[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    p = command_parser(__doc__)
    p.add_argument("--model", default="1b", help="1b, or a .json file with InternVL3's vocabulary")
    p.add_argument("--frames", type=int, default=4)
    p.add_argument("--new-tokens", type=int, default=64)
    p.add_argument("--seed", type=int, default=0)
    p.add_argument("--threads", type=int, default=2)
    args = p.parse_args(argv)
    try:
        check_result_target(args.json)
        if min(args.frames, args.new_tokens, args.threads) < 1 or args.seed < 0:
            raise ValueError("--frames, --new-tokens and --threads must be positive, --seed not negative")
        from transformers import __version__ as transformers_version

        with tempfile.TemporaryDirectory(prefix="parity-") as directory:
            work = Work(Path(directory), args.model, args.frames, args.new_tokens, args.seed, args.threads)
            length = len(work.prompt()[1]) + args.new_tokens
            if length > work.config.language.max_context:
                raise ValueError(f"{length} tokens, the model reads {work.config.language.max_context}")
            arrays = {name: in_own_process(name, work) for name in STAGES}
    except (ValueError, OSError, ImportError) as error:
        return bad_input("parity_1b", error)
    theirs = arrays.pop("transformers")
    compared = {name: compare(theirs, ours) for name, ours in arrays.items()}
    processes = {
        name: {"wall_s": float(a["_wall_s"]), "peak_rss_bytes": int(a["_peak_rss_bytes"])}
        for name, a in {"transformers": theirs, **arrays}.items()
    }
    result = {
        "model": args.model,
        "transformers": transformers_version,
        "torch": torch.__version__,
        "prompt_tokens": int(theirs["last_layer_kv"].shape[1]),
        "frames": args.frames,
        "threads": args.threads,
        "seed": args.seed,
        "compared": compared,
        "processes": processes,
    }
    write_result(args.json, result)
    if args.json != "-":
        show(result)
    kept = all(row.get("kept", True) for rows in compared.values() for row in rows.values())
    return EXIT_DONE if kept else EXIT_CHECK_FAILED


if __name__ == "__main__":
    sys.exit(main())
