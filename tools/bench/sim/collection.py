"""How many drives and tours one core records in an hour, and what a frame that is learned from costs.

    python -m tools.bench.sim.collection --recipe nano --json out/bench/collection.json
    python -m tools.bench.sim.collection --kinds tours --profile      # with the functions that take the time

They are recorded as by `edge-train`, one after the other in this process, into a temporary folder. The figures are
processor time, so that a busy machine changes them little. Exit code 0: done, 1: nothing was recorded, 2: bad
arguments.
"""

from __future__ import annotations

import argparse
import cProfile
import json
import pstats
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

from edge.core.cli import EXIT_BAD_INPUT, EXIT_CHECK_FAILED, EXIT_DONE, check_result_target, command_line, write_result
from export.core.typed import plain
from firmware_bridge.system.terminal import CommandParser
from tools.train.collect.collection import Collection
from tools.train.collect.worker import messages
from tools.train.config.checks import TrainError
from tools.train.config.collect import RATE_HZ
from tools.train.config.recipe import RecipeError, load_recipe

DRIVES, TOURS = "drives", "tours"
KINDS: Final = (DRIVES, TOURS)
SHOWN: Final = 25
"""Functions that `--profile` prints."""


def measure(kind: str, recipe_name: str, changes: Sequence[str], count: int, seed: int) -> dict[str, Any]:
    """Record `count` drives or tours of a recipe and return their figures. Raises TrainError."""
    recipe = load_recipe(recipe_name, list(changes))
    tour = replace(recipe.sft.tours, count=count) if kind == TOURS else None
    collection = Collection("b", count, seed, 0, recipe.collect, tour=tour)
    done, dropped = [], 0
    with tempfile.TemporaryDirectory(prefix="edge-collection-") as folder:
        (Path(folder) / "drives").mkdir()
        started_s = time.process_time()
        for order in collection.orders(Path(folder), lambda _: False):
            for message in messages(json.loads(json.dumps(plain(order)))):
                done += [message["drive"]] if "drive" in message else []
                dropped += "dropped" in message and message["dropped"] not in order.skip
        spent_s = time.process_time() - started_s
    seconds = sum(entry["frames"] for entry in done) / RATE_HZ
    return {
        "kind": kind, "recorded": len(done), "dropped": dropped, "cpu_s": round(spent_s, 2), "recorded_s": seconds,
        "per_core_hour": round(3600 * len(done) / spent_s, 1) if done else 0.0,
        "cpu_s_per_recorded_s": round(spent_s / seconds, 4) if seconds else None, "tagged": "measured",
    }  # fmt: skip


@command_line("collection", dict.fromkeys((TrainError, RecipeError), EXIT_BAD_INPUT))
def main(argv: Sequence[str] | None = None) -> int:
    """Run the benchmark; returns its exit code."""
    p = CommandParser(
        "python -m tools.bench.sim.collection", description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    p.add_argument("--recipe", default="nano", metavar="NAME|FILE", help="recipe (default: nano)")
    p.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="change a value of the recipe")
    p.add_argument("--kinds", choices=(*KINDS, "both"), default="both", help="what is recorded (default: both)")
    p.add_argument("--count", type=int, default=12, metavar="N", help="of each kind (default: 12)")
    p.add_argument("--seed", type=int, default=0, metavar="N", help="of the collection (default: 0)")
    p.add_argument("--profile", action="store_true", help="print the functions that take the most time")
    p.add_argument("--json", metavar="FILE|-", help="write the figures as JSON")
    args = p.parse_args(argv)
    check_result_target(args.json)
    if not 1 <= args.count <= 10_000 or args.seed < 0:
        expected = "expected --count 1 to 10000 and --seed 0 or more"
        sys.stderr.write(f"collection: {expected}, found {args.count} and {args.seed}\n")
        return EXIT_BAD_INPUT
    profile = cProfile.Profile() if args.profile else None
    with profile or nullcontext():
        kinds = KINDS if args.kinds == "both" else (args.kinds,)
        rows = [measure(kind, args.recipe, args.set, args.count, args.seed) for kind in kinds]
    for row in rows:
        each = row["cpu_s_per_recorded_s"]
        sys.stdout.write(
            f"{row['kind']}: {row['recorded']} recorded, {row['dropped']} dropped in {row['cpu_s']:.1f} s of processor "
            f"time; {row['per_core_hour']:.0f} a core-hour, {1e3 * (each or 0.0):.1f} ms a recorded second\n"
        )
    if profile is not None:
        pstats.Stats(profile, stream=sys.stdout).sort_stats("cumulative").print_stats(SHOWN)
    write_result(args.json, {"rows": rows})
    return EXIT_DONE if all(row["recorded"] for row in rows) else EXIT_CHECK_FAILED


if __name__ == "__main__":
    sys.exit(main())
