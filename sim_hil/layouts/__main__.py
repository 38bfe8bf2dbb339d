"""`python -m sim_hil.layouts`: write a generated layout as a scene file, optionally with a map."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from edge.core.cli import check_result_target, command_line, write_named, write_result
from firmware_bridge.system.terminal import CommandParser
from sim_hil.layouts import BENCHMARK_SEEDS, KINDS, RESERVED_BELOW, LayoutError, generate
from sim_hil.scene.map import draw_map
from sim_hil.scene.scene import Scene, scene_to_toml
from sim_hil.world.drawing.textures import png_bytes

_EXAMPLES = f"""examples:
  python -m sim_hil.layouts hospital --seed 4711 --out hospital_4711.toml --map hospital_4711.png
  python -m sim_hil.layouts office --benchmark --out sim_hil/scenes/office.toml
seeds below {RESERVED_BELOW} are the benchmark's; --benchmark takes the one of its scene
exit codes: 0 done, 1 no sound layout for this seed, 2 bad arguments"""


def _parser() -> argparse.ArgumentParser:
    parser = CommandParser(
        prog="python -m sim_hil.layouts", description="Generate a layout of one of DynaNav's environments.",
        epilog=_EXAMPLES, formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    parser.add_argument("kind", choices=KINDS)
    which = parser.add_mutually_exclusive_group(required=True)
    which.add_argument("--seed", type=int, metavar="N", help=f"{RESERVED_BELOW} or more")
    which.add_argument("--benchmark", action="store_true", help="the benchmark's own scene of this kind")
    parser.add_argument("--out", type=Path, required=True, metavar="FILE", help="scene file to write (.toml)")
    parser.add_argument("--map", type=Path, metavar="FILE", help="also draw it from above (.png)")
    parser.add_argument("--px-per-m", type=float, default=20.0, metavar="N", help="scale of the map (default 20)")
    parser.add_argument("--json", metavar="FILE|-", help="what was made, as JSON")
    return parser


def _summary(scene: Scene) -> dict[str, object]:
    return {
        "name": scene.name,
        "size_m": list(scene.floor_max_m),
        "walls": len(scene.walls),
        "objects": len(scene.objects),
        "landmarks": len(scene.landmarks()),
        "areas": len(scene.areas),
        "places": sum(place.capacity for place in scene.places),
    }


@command_line("layouts")
def main(argv: list[str] | None = None) -> int:
    """Run the command and return its exit code."""
    args = _parser().parse_args(argv)
    if args.out.suffix != ".toml":
        sys.stderr.write(f"--out: expected a file that ends in .toml, found {args.out}" + "\n")
        return 2
    if not args.benchmark and 0 <= args.seed < RESERVED_BELOW:
        sys.stderr.write(f"--seed: {args.seed} is the benchmark's; take {RESERVED_BELOW} or more, or --benchmark\n")
        return 2
    seed = BENCHMARK_SEEDS[args.kind] if args.benchmark else args.seed
    try:
        check_result_target(args.json)
        for option, path in (("--out", args.out), ("--map", args.map)):
            check_result_target(None if path is None else str(path), option)
        scene = generate(args.kind, seed, reserved=args.benchmark)
        write_named(args.out, scene_to_toml(scene))
        if args.map is not None:
            write_named(args.map, png_bytes(draw_map(scene, args.px_per_m, names=True)))
        write_result(args.json, _summary(scene))
    except LayoutError as error:
        sys.stderr.write(f"{error}\n")
        return 1 if seed >= 0 else 2
    except OSError as error:
        sys.stderr.write(f"{error}\n")
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
