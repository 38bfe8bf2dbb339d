"""Exports the models that `tools.findings` compares, from a training run and its ablations."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from safetensors import SafetensorError, safe_open

from edge.core.cli import EXIT_BAD_INPUT, EXIT_CHECK_FAILED, EXIT_DONE, command_line, messages
from firmware_bridge.system.terminal import CommandParser
from tools.findings.rows import AFTER, BEFORE
from tools.train.config.recipe import Recipe, RecipeError, load_recipe
from tools.train.run.network_file import COMMAND, ExportError, export_artifacts, stage_weights

EXAMPLES: Final = """examples:
  edge-train all --preset nano --out out/run
  edge-train imitate --from out/run --variant full --out out/ablations/full    # the reference of the ablations
  edge-train imitate --from out/run --variant no-latency --out out/ablations/no-latency
  edge-train imitate --from out/run --variant no-motion-offset --out out/ablations/no-motion-offset
  edge-train imitate --from out/run --variant no-reasoning --out out/ablations/no-reasoning
  python -m tools.findings.models --run out/run --ablations out/ablations --out out/models
  python -m tools.findings --artifacts out/models --out out/findings --jobs 2
exit codes: 0 done, 1 an export failed, 2 bad arguments or input, 130 interrupted
"""


_EXITS: Final = {ExportError: EXIT_CHECK_FAILED, RecipeError: EXIT_BAD_INPUT, OSError: EXIT_BAD_INPUT}
_print = messages("findings-models")


@dataclass(frozen=True)
class Model:
    """Model to export as `name`: the weights of a run's stage."""

    name: str
    weights: Path
    recipe: Recipe


def models_of(run: Path, ablations: Path | None) -> Iterator[Model]:
    """Yield `rl` and `no-rl` of the run, and every ablation by its folder's name. Raises RecipeError if one is no run.

    If reinforcement learning kept no policy, `rl` is imitation's policy, which is shipped then.
    """
    recipe = _recipe(run)
    before, after = (stage_weights(run, stage) for stage in ("imitate", "rl"))
    if before.is_file():
        yield Model(BEFORE, before, recipe)
    if after.is_file() and not (before.is_file() and same_policy(before, after)):
        yield Model(AFTER, after, recipe)
    elif before.is_file():
        yield Model(AFTER, before, recipe)
    for folder in sorted(path for path in (ablations.iterdir() if ablations is not None else ()) if path.is_dir()):
        own = _recipe(folder)
        if (weights := stage_weights(folder, "imitate")).is_file():
            yield Model(folder.name, weights, own)


def same_policy(one: Path, other: Path) -> bool:
    """Return whether two weight files are equal except for the value network. Raises RecipeError."""
    try:
        with safe_open(str(one), framework="np") as first, safe_open(str(other), framework="np") as second:
            names = [{name for name in file.keys() if not name.startswith("value.")} for file in (first, second)]  # noqa: SIM118 - not a mapping
            return names[0] == names[1] and all(
                np.array_equal(first.get_tensor(name), second.get_tensor(name)) for name in names[0]
            )
    except SafetensorError as error:
        raise RecipeError(f"{one} or {other}: not weights ({error})") from error


def _recipe(run: Path) -> Recipe:
    path = run / "recipe.toml"
    if not path.is_file():
        raise RecipeError(f"{run}: holds no run of edge-train")
    return load_recipe(str(path))


def parser() -> argparse.ArgumentParser:
    """Return the argument parser."""
    p = CommandParser(
        "python -m tools.findings.models", description=__doc__, epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    p.add_argument("--run", type=Path, required=True, metavar="DIR", help="run of edge-train")
    p.add_argument("--ablations", type=Path, metavar="DIR", help="one run per variant, named like it")
    p.add_argument("--out", type=Path, required=True, metavar="ROOT", help="folder of the models")
    return p


@command_line("findings-models", _EXITS)
def main(argv: Sequence[str] | None = None, command: Sequence[str] = COMMAND) -> int:
    """Run the command; returns its exit code."""
    args = parser().parse_args(argv)
    models = list(models_of(args.run, args.ablations))
    if not models:
        raise RecipeError(f"{args.run}: has no weights yet; run edge-train imitate first")
    for model in models:
        _print(f"{model.name}: {model.weights}")
        if model.name == AFTER and model.weights == stage_weights(args.run, "imitate"):
            _print(f"{AFTER}: reinforcement learning kept no policy; this is imitation's")
        export_artifacts(model.weights, model.recipe.model, args.out / model.name, command=command)
    return EXIT_DONE


if __name__ == "__main__":
    sys.exit(main())
