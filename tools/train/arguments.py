"""Command line of `edge-train`: trains navigation weights from scratch, one stage at a time or all in order.

This module does without torch, which takes seconds to load: bad arguments are refused at once.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import re
from pathlib import Path
from typing import Final

from edge.core.cli import check_result_directory, check_result_target
from edge.inference.latency_profile import load_profile
from firmware_bridge.system.terminal import CommandParser
from tools.train.config.checks import TrainError, check_processes, check_run_folder
from tools.train.config.recipe import ALL, VARIANTS, Recipe, load_recipe, recipe_names

COMMAND: Final = "edge-train"
REFUSALS: Final = (TrainError, ValueError, OSError)
"""Errors of `check`."""
SUMMARY: Final = "Train navigation weights from scratch, one stage at a time or all stages in order."
COMMANDS: Final = (*ALL, "all", "card")
BORROWED: Final = ("collect", "encoder", "sft")
"""Stages that --from takes from another run: those that do not depend on the action expert."""
EXAMPLES: Final = """examples:
  edge-train all --preset nano --out out/nano-run --dry-run        print the steps and their estimated duration
  edge-train all --preset nano --out out/nano-run                  all stages; Ctrl-C interrupts, --resume continues
  edge-train collect --preset nano --out out/run                   a single stage
  edge-train sft --out out/run --set sft.epochs=12
  torchrun --nproc-per-node 2 -m tools.train.cli sft --out out/run           also: encoder, imitate, dagger, all
  edge-train all --preset nano --out out/mine-run --delay-profile orin.latency.json
  edge-train imitate --from out/run --variant no-latency --out out/no-latency
  edge-train dagger --preset nano --checkpoint out/run/model.safetensors --after imitate --out out/more
  edge-train card --out out/run --scores out/bench/result.json --ship out/run/ship    model card, weights to publish

stages: collect (the expert drives), encoder (vision encoder on simulator labels), sft (reasoning text and waypoints),
imitate (actions under delay), dagger (the policy drives, the expert relabels, imitation continues), rl (PPO),
evaluate (episodes in layouts that no stage has used)
exit codes: 0 done, 1 an export, a drive or an episode failed, 2 bad arguments or input, 3 refused (artifacts),
            130 interrupted
"""


def parser() -> argparse.ArgumentParser:
    """Build the command line of `edge-train`."""
    p = CommandParser(
        COMMAND,
        description=SUMMARY,
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    p.add_argument("command", choices=COMMANDS, metavar="STAGE", help=", ".join(COMMANDS))
    which = p.add_mutually_exclusive_group()
    which.add_argument(
        "--preset", metavar="NAME", help=f"recipe: {', '.join(recipe_names())} (default: the run's, or nano)"
    )
    which.add_argument("--recipe", type=Path, metavar="FILE.toml", help="recipe file")
    p.add_argument(
        "--set", dest="settings", metavar="KEY=VALUE", action="append", default=[],
        help="change a value of the recipe: seed, STAGE.field or model.SECTION.field; repeatable",
    )  # fmt: skip
    p.add_argument(
        "--variant",
        choices=VARIANTS,
        metavar="NAME",
        help=f"an ablation or baseline of the paper: {', '.join(VARIANTS)}",
    )
    p.add_argument("--out", type=Path, metavar="DIR", help="run folder")
    p.add_argument("--resume", action="store_true", help="continue an interrupted stage; finished stages are skipped")
    p.add_argument(
        "--drives",
        type=Path,
        metavar="DIR",
        help="train on this data set (tools.train.importers) instead of collecting",
    )
    p.add_argument("--from", dest="base", type=Path, metavar="DIR", help=f"reuse {', '.join(BORROWED)} of another run")
    p.add_argument(
        "--checkpoint", type=Path, metavar="PATH", action="append", default=[],
        help="initial weights, such as a backbone's (in a format that edge-export reads); repeatable",
    )  # fmt: skip
    p.add_argument(
        "--after",
        metavar="STEP",
        help="treat the weights of --checkpoint as the result of this step; continue after it",
    )
    p.add_argument("--device", default="cpu", metavar="cpu|cuda", help="device that trains the networks (default: cpu)")
    p.add_argument("--delay-profile", type=Path, metavar="FILE", help="train with these delays (edge-calib latency)")
    p.add_argument(
        "--scores", type=Path, metavar="FILE", action="append", default=[], help="card: edge-bench's result.json"
    )
    p.add_argument("--ship", type=Path, metavar="DIR", help="card: also write the weights for publication there")
    p.add_argument("--dry-run", action="store_true", help="print the steps and their estimated duration, then exit")
    p.add_argument("--json", metavar="FILE|-", help="write the result as JSON")
    return p


def check(args: argparse.Namespace) -> Recipe:
    """Check all but data and weights; return the recipe. Raises TrainError, RecipeError, LatencyError, OSError."""
    check_result_target(args.json)
    check_processes(os.environ)
    recipe = _recipe(args)
    if re.fullmatch(r"cpu|cuda(:[0-9]{1,3})?", args.device) is None:
        raise TrainError(f"--device {args.device}: expected cpu, cuda or cuda:N")
    if args.drives is not None and args.command == "card":
        raise TrainError("--drives belongs to stages, not to card")
    if args.dry_run:
        return recipe
    if args.out is None:
        raise TrainError("--out is missing: expected the folder of the run, e.g. --out out/run")
    check_result_directory(args.out)
    check_result_directory(args.ship, "--ship")
    if args.command == "card":
        for score in args.scores:
            if not score.is_file():
                raise TrainError(f"--scores {score}: expected edge-bench's result.json, found no file")
        return recipe
    if args.scores or args.ship:
        raise TrainError("--scores and --ship belong to card")
    if args.base is not None and args.checkpoint:
        raise TrainError("--from and --checkpoint: expected one of them, both name the initial weights")
    if args.base is not None and args.drives is not None:
        raise TrainError("--from and --drives: expected one of them, both name the drives")
    if args.after is not None and args.drives is not None:
        raise TrainError("--after and --drives: expected one of them, --after continues without earlier drives")
    if args.after is not None and not args.checkpoint:
        raise TrainError("--after: expected --checkpoint with it, the weights that the step wrote")
    _check_inputs(args)
    check_run_folder(args.out)
    return recipe


def _check_inputs(args: argparse.Namespace) -> None:
    """Check that the named inputs exist, before the run folder is made. Raises TrainError."""
    if args.drives is not None and not (args.drives / "dataset.json").is_file():
        raise TrainError(f"--drives {args.drives}: expected a data set with dataset.json, found none")
    if args.base is not None and not (args.base / "recipe.toml").is_file():
        raise TrainError(f"--from {args.base}: not a run folder of edge-train")
    for path in args.checkpoint:
        if not (path.is_file() or path.is_dir()):
            raise TrainError(f"--checkpoint {path}: expected a file or a folder of weights, found none")


def _recipe(args: argparse.Namespace) -> Recipe:
    """Load the named recipe, else the recipe of the run in --out or --from, else nano."""
    # Implied settings come first, so that --set overrides them. No drives are added to another run's.
    implied = ["dagger.rounds=0"] if args.base is not None else []
    settings = [*implied, *VARIANTS[args.variant or "full"], *args.settings]
    if args.delay_profile is not None:
        path, _ = own_profile(args)
        # Started stages keep their profile: `rl` alone does not change imitation's, nor the other way round.
        settings += [f"imitate.delays.profile={path}"] if args.command != "rl" else []
        settings += [f"rl.delay_profile={path}"] if args.command != "imitate" else []
    there = [folder / "recipe.toml" for folder in (args.out, args.base) if folder is not None]
    found = next((path for path in there if path.is_file()), None)
    if args.preset is not None and args.preset not in recipe_names():
        raise TrainError(f"--preset {args.preset}: expected one of {', '.join(recipe_names())}; a file is a --recipe")
    if args.recipe is not None and args.recipe.suffix != ".toml":
        raise TrainError(f"--recipe {args.recipe}: expected a file that ends in .toml")
    if args.command == "card" and found is None:
        raise TrainError("card: expected --out to be the folder of a run")
    return load_recipe(str(args.preset or args.recipe or found or "nano"), settings)


def own_profile(args: argparse.Namespace) -> tuple[Path, str]:
    """Return (path, content) of the run's own copy of --delay-profile; its name contains the hash of its content.

    Without a copy, a resumed run would silently train with other delays after the file was measured again.
    """
    content = json.dumps(load_profile(args.delay_profile).as_json()) + "\n"
    if args.out is None:
        return args.delay_profile.absolute(), content
    return args.out.absolute() / f"delays-{hashlib.sha256(content.encode()).hexdigest()[:12]}.json", content
