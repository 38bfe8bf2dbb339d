"""The model card: weights, scores, training data, training and limits.

If the run started from weights with a card, that card's data and training are appended: the history stays complete.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import prod
from pathlib import Path
from typing import Any, Final

from safetensors import SafetensorError, safe_open

from edge.core.cli import write_whole
from export.model.network import PARTS
from export.model.weights import WeightsInfo, save_weights
from firmware_bridge.system.input_file import read_json
from reporting.progress import duration
from sim_hil.benchmark.conditions.conditions import Conditions
from tools.train.config.checks import TrainError
from tools.train.config.recipe import STAGES, Recipe
from tools.train.drives.drive import file_sha256
from tools.train.pipeline.chain import ADOPTED, GO_ON
from tools.train.run.network_file import CARD, START, START_CARD, read_network, stage_weights
from tools.train.run.run_dir import IMPORTED, VERSIONS, RunDir, read_record

_PART_NAMES: Final = dict(
    zip(PARTS, ("vision encoder", "language model", "action expert", "value network"), strict=True)
)
_HEADINGS: Final = ("## ", "### ", "#### ", "##### ")  # Markdown has six levels
_THEIRS: Final = "It began with weights of others (`--checkpoint`), whose licence holds for it."
_BEFORE: Final = "## What it went on from"
_SHIPPED_RECIPE: Final = ".recipe.toml"
_OUR_DRIVES: Final = (
    "Drives of a privileged expert in simulated training scenes, made by this repository's own code: generated",
    "layouts, the demo's corridor, crowds and instruction patterns. A test checks that none of them occurs in the",
    "benchmark's episodes. They contain no recording of a person or a place.",
)
_OTHERS_DRIVES: Final = (
    "Drives that were recorded elsewhere and imported (`--drives`); this run does not know their origin.",
)
_LIMITS_HERE: Final = """\
* It was trained and measured in simulated scenes with simulated people and rendered images. Its performance with a real
  camera is unknown: train it further on recorded drives first (`tools/train/importers` reads them).
"""
_LIMITS_ELSEWHERE: Final = """\
* It was measured in simulated scenes with simulated people, if at all. Its performance where its drives were recorded
  is unknown.
"""
LIMITS: Final = """\
* It understands the vocabulary of its instruction grammar and its landmarks, in English. It may ignore other words.
* It is not a safety function. Fences, the emergency stop, a supervising person, the supervisor's limits and the
  bridge's deadman are; they do not depend on the model.
* Speeds, camera height and field of view are those of the simulated Go2 and Carter.
"""


def write_card(run_dir: RunDir, recipe: Recipe, scores: Sequence[Path] = ()) -> Path:
    """Write the card beside the run's weights and return its path. `scores`: result files of edge-bench.

    Raises TrainError, OSError.
    """
    if not run_dir.model_path.is_file():
        raise TrainError(f"{run_dir.out}: no {run_dir.model_path.name} yet; train first")
    path = run_dir.out / CARD
    write_whole(path, card(run_dir, recipe, run_dir.model_path, [score(each) for each in scores]))
    return path


def ship(run_dir: RunDir, recipe: Recipe, folder: Path, scores: Sequence[Path] = ()) -> Path:
    """Write the run's weights for publication, with card and recipe: float16, without the value network.

    Returns the weights' path. Raises TrainError, OSError.
    """
    if not run_dir.model_path.is_file():
        raise TrainError(f"{run_dir.out}: no {run_dir.model_path.name} yet; train first")
    model = read_network(run_dir.model_path, recipe.model, recipe.seed).half()
    with safe_open(str(run_dir.model_path), framework="pt") as file:
        about = file.metadata() or {}
    path = folder / f"{recipe.model.name}.safetensors"
    info = WeightsInfo(trained=about.get("trained") == "true", origin=f"{about.get('origin', 'unknown')}, float16")
    save_weights(model, path, info, parts=[part for part in PARTS if part != "value"])
    write_whole(path.with_suffix(".md"), card(run_dir, recipe, path, [score(each) for each in scores]))
    write_whole(path.with_suffix(_SHIPPED_RECIPE), run_dir.recipe_path.read_text(encoding="utf-8"))
    return path


def card(run_dir: RunDir, recipe: Recipe, weights: Path, scores: Sequence[Mapping[str, object]] = ()) -> str:
    """Return the card's text; it depends on the run's files alone."""
    found = {name: result for name in STAGES if (result := run_dir.result(name)) is not None}
    results = {name: result for name, result in found.items() if ADOPTED not in result}
    after = next((str(result.get("after")) for result in found.values() if ADOPTED in result), None)
    before, imported = _card_before(run_dir), results.get("collect", {}).get(IMPORTED) is True
    recipe_file = run_dir.recipe_path if weights == run_dir.model_path else weights.with_suffix(_SHIPPED_RECIPE)
    blocks = [
        f"# {recipe.name}: weights for tic-vla-edge\n",
        _network(weights, recipe, _licence(run_dir.begun(START), before)),
        "## Scores\n\n" + _scores(results.get("evaluate"), scores),
        "## Data\n\n" + _data(run_dir, results.get("collect")),
        "## Training\n\n" + _training(run_dir, recipe, results, after, recipe_file),
        "## Limits\n\n" + (_LIMITS_ELSEWHERE if imported else _LIMITS_HERE) + LIMITS,
        *([] if before is None else [f"{_BEFORE}\n\n{_history(before)}"]),
    ]
    return "\n".join(blocks)


def _card_before(run_dir: RunDir) -> str | None:
    """Return the card of the run's start weights; None if they had none."""
    path = stage_weights(run_dir.out, START).with_name(START_CARD)
    return path.read_text(encoding="utf-8") if path.is_file() else None


def _history(text: str) -> str:
    """Return a card's data and training, and its own history, with headings one level deeper."""
    sections = [f"## {section.rstrip()}\n" for section in text.split("\n## ")[1:]]
    kept = [each for each in sections if each.startswith(("## Data\n", "## Training\n", f"{_BEFORE}\n"))]
    lines = (line for each in kept for line in each.split("\n"))
    return "\n".join(line.replace("## ", "### ", 1) if line.startswith(_HEADINGS) else line for line in lines)


def _licence(begun_with_weights: bool, before: str | None) -> str:
    if begun_with_weights and (before is None or _THEIRS in before):
        return _THEIRS
    return "Licence: Apache-2.0, as the repository. No weights of anybody else are in it."


def score(path: Path) -> dict[str, Any]:
    """Read conditions and summary of a benchmark's result file. Raises TrainError."""
    try:
        content = read_json(path)
        found = {key: content[key] for key in ("suite", "conditions", "summary", "latency", "trained")}
        found["conditions"] = Conditions.of_json(content["conditions"])
        finished = content["summary"]["finished"]
        _scores(None, [found])  # whatever the card reads of it
    except (OSError, ValueError, LookupError, TypeError, AttributeError) as error:
        raise TrainError(f"--scores {path}: expected a result.json of edge-bench ({error!r})") from error
    if not finished:
        raise TrainError(f"--scores {path}: expected a finished run; continue it with edge-bench --resume")
    return found


def parameters(weights: Path) -> dict[str, int]:
    """Count the weights of each part of the network. Raises TrainError."""
    counts = dict.fromkeys(PARTS, 0)
    try:
        with safe_open(str(weights), framework="pt") as file:
            for name in file.keys():  # noqa: SIM118 — not a mapping
                counts[name.split(".")[0]] += prod(file.get_slice(name).get_shape())
    except (OSError, SafetensorError, KeyError) as error:
        raise TrainError(f"{weights}: expected weights of edge-train, cannot be read ({error}); train again") from error
    return counts


def _network(weights: Path, recipe: Recipe, licence: str) -> str:
    counts, size = parameters(weights), weights.stat().st_size
    rows = "\n".join(f"| {_PART_NAMES[part]} | {count:,} |" for part, count in counts.items() if count)
    return (
        f"Network `{recipe.model.name}`: maps camera images, odometry and an English instruction to motion.\n"
        f"{licence}\n\n"
        f"`{weights.name}`: {size / 1e6:.1f} MB, SHA-256 `{file_sha256(weights)}`\n\n"
        f"| part | weights |\n|---|---:|\n{rows}\n| all | {sum(counts.values()):,} |\n"
    )


def _scores(evaluation: Mapping[str, Any] | None, scores: Sequence[Mapping[str, Any]]) -> str:
    rows = []
    for each in scores:
        delay_s = (each["latency"].get("delay_s") or {}).get("mean")
        delay = "" if delay_s is None else f", mean Δt {delay_s:.2f} s"
        rows.append(_row(f"{Path(each['suite']).stem}, {each['conditions'].describe()}{delay}", each["summary"]))
    if evaluation is not None:
        try:
            where = f"unseen training scenes, lockstep, async, latency {evaluation['latency_s']:g} s"
            rows.append(_row(where, evaluation["summary"]))
        except (LookupError, TypeError, ValueError) as error:
            raise TrainError(
                f"evaluate/result.json: expected latency_s and a summary ({error!r}); restore it"
            ) from error
    if not rows:
        return "Not measured yet.\n"
    head = "| episodes of | n | SR % | SPL % | CR % | NE m |\n|---|---:|---:|---:|---:|---:|\n"
    note = "\nMeasured; in brackets 95 % bootstrap intervals over tasks and their episodes.\n"
    return head + "\n".join(rows) + "\n" + note


def _row(where: str, summary: Mapping[str, Any]) -> str:
    cells = [where, str(summary["episodes"])]
    for name in ("sr", "spl", "cr", "ne_m"):
        interval = summary.get(f"{name}_ci95")
        shown = "" if interval is None else f" ({interval[0]:.1f} to {interval[1]:.1f})"
        cells.append(f"{summary[name]:.1f}{shown}" if summary[name] is not None else "–")
    return f"| {' | '.join(cells)} |"


def _data(run_dir: RunDir, collected: Mapping[str, object] | None) -> str:
    rounds = [run_dir.result(path.parent.name) for path in sorted(run_dir.out.glob("dagger-*/result.json"))]
    own = [result for result in rounds if result is not None and ADOPTED not in result]
    lines: list[str] = []
    if collected is not None:
        lines += [*(_OTHERS_DRIVES if collected.get(IMPORTED) is True else _OUR_DRIVES), "", *_facts(collected)]
    else:
        lines += [*(_OUR_DRIVES if own else ()), "The expert's drives were not collected by this run."]
    for number, result in enumerate(rounds, 1):
        if result is not None and ADOPTED not in result:
            title = f"DAgger round {number}, driven by the policy, relabelled by the expert:"
            lines += ["", title, "", *_facts(result)]
    return "\n".join(lines) + "\n"


def _training(
    run_dir: RunDir, recipe: Recipe, results: Mapping[str, Any], after: str | None, recipe_file: Path
) -> str:  # fmt: skip
    versions = read_record(run_dir.out / VERSIONS)
    if missing := {"packages", "python", "cpus", "machine"} - versions.keys():
        raise TrainError(f"{run_dir.out / VERSIONS}: expected {', '.join(sorted(missing))} too; restore it")
    packages = ", ".join(f"{name} {found}" for name, found in dict(versions["packages"]).items() if found)
    went_on = " --checkpoint WEIGHTS" if run_dir.begun(START) else ""
    went_on += "" if after is None else f" --after {after}"
    if results.get("collect", {}).get(IMPORTED) is True:
        went_on += " --drives DATASET"
    if run_dir.borrowed("collect"):
        went_on += " --from RUN"
    sha256 = file_sha256(run_dir.recipe_path)
    lines = [
        f"Seed {recipe.seed}; every number is in `{recipe_file.name}` (SHA-256 `{sha256}`),",
        f"made with `edge-train all --recipe {recipe_file.name}{went_on}`. Python {versions['python']}, {packages}.",
    ]
    if later := versions.get("later"):
        lines.append(f"It was continued with other code, versions or machines {len(later)} times: `{VERSIONS}`.")
    if timings := run_dir.timings():
        each = ", ".join(f"{step} {duration(seconds)}" for step, seconds in timings.items())
        lines.append(
            f"It took {duration(sum(timings.values()))} on {versions['cpus']} cores ({versions['machine']}): {each}."
        )
    for name in ("encoder", "sft", "imitate", "rl"):
        if name in results:
            again = run_dir.retired(name) if name in GO_ON else 0
            after = f" (after {again} rounds of DAgger)" if again else ""
            lines += ["", f"### {name}{after}", "", *_facts(results[name])]
    return "\n".join(lines) + "\n"


def _facts(result: Mapping[str, object], under: str = "") -> list[str]:
    """Format a result as one line per value; lists are omitted."""
    lines = []
    for key, value in sorted(result.items()):
        if isinstance(value, Mapping):
            lines += _facts(value, f"{under}{key}.")
        elif isinstance(value, float):
            lines.append(f"* {under}{key}: {value:.6g}")
        elif isinstance(value, str | int) or value is None:
            lines.append(f"* {under}{key}: {'–' if value is None else value}")
    return lines
