"""`edge-soak`: drive task after task for hours in real time with random faults, and judge the measurements."""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from edge.artifacts.files import ArtifactError
from edge.artifacts.manifest import load_artifacts
from edge.core.cli import (
    EXIT_BAD_INPUT,
    EXIT_CHECK_FAILED,
    EXIT_DONE,
    EXIT_INTERRUPTED,
    EXIT_REFUSED,
    check_result_target,
    command_line,
    stop_signals,
    write_result,
)
from firmware_bridge.core.config import load_robot_config
from reporting.progress import Progress
from sim_hil.realtime.children import StepError
from sim_hil.realtime.robots import GO2, ROBOTS, free_domain
from sim_hil.robots.odometry_noise import LEVELS
from sim_hil.scene.scene import SceneError, load_scene
from sim_hil.soak.faults import DEFAULT_MENU, SoakInputError, load_menu
from sim_hil.soak.report import write_report
from sim_hil.soak.run import SoakFolder, SoakOptions, lost_budget, run_legs, soak_result
from sim_hil.soak.verdict import DEFAULT_BUDGET, PASS, UNDECIDED, applicable, load_budget

MODES: Final = ("async", "sync", "no-reasoning")
STATUS_PERIOD_S: Final = 30.0
UNTRAINED_MPS: Final = 0.14
"""Default speed limit for untrained weights, m/s: they drive into walls, which below 0.2 m/s (edge.odometry.gate) does
not end the run, so that the growth of the runner can be measured."""
_UNITS_S: Final = {"s": 1.0, "m": 60.0, "h": 3600.0, "d": 86_400.0}

EXAMPLES = """examples:
  edge-soak --artifacts out/nano --duration 1h --out out/soak
  edge-soak --artifacts out/nano --duration 8h --leg 30m --people 12 --scene hospital --scene office --out out/night
  edge-soak --artifacts out/nano --duration 8h --out out/night --resume      # with the same options, after a kill
  edge-soak --artifacts out/nano --duration 5m --faults none --json - --out out/quick
  edge-soak --artifacts out/nano --duration 1h --robot carter-can --out out/carter

A leg is one run of the stack (edge-hil, edge-bridge, edge-run) in one scene, with one task after another.
Default budget and faults: sim_hil/soak/budget.toml and sim_hil/soak/faults.toml; copy and change them. Only the go2
has the faults of the robot's side: other robots get those that end a process.
A soak ends after the leg in which a budget line failed that no later leg can mend.
exit codes: 0 budget met, 1 budget exceeded, undecided, or no leg could run, 2 bad arguments or input,
            3 refused (artifacts), 130 interrupted (a report of the finished part is written)
"""


def parser() -> argparse.ArgumentParser:
    """Return the argument parser."""
    p = argparse.ArgumentParser(
        "edge-soak", description=__doc__, epilog=EXAMPLES, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    p.add_argument("--artifacts", type=Path, required=True, metavar="DIR", help="directory made by edge-export")
    p.add_argument(
        "--duration", type=parse_seconds, required=True, metavar="T", help="total time, such as 90s, 10m, 1h or 1d"
    )
    p.add_argument(
        "--out",
        type=Path,
        required=True,
        metavar="DIR",
        help="directory for samples, legs, result.json and report.html",
    )
    p.add_argument("--faults", default="default", metavar="FILE|none", help="fault menu (default: the package's)")
    p.add_argument("--budget", type=Path, metavar="FILE", help="budget file (default: the package's)")
    p.add_argument(
        "--scene",
        action="append",
        metavar="NAME|FILE",
        help="scene (default hospital); if repeated, one per leg in turn",
    )
    p.add_argument("--people", type=int, default=6, metavar="N", help="walking people (default 6)")
    p.add_argument(
        "--seed", type=int, default=0, metavar="N", help="random seed of tasks, people and faults (default 0)"
    )
    p.add_argument("--leg", type=parse_seconds, default=1200.0, metavar="T", help="length of a leg (default 20m)")
    p.add_argument("--mode", choices=MODES, default="async", help="reasoning mode of edge-run (default async)")
    p.add_argument("--release-delay", default="0", metavar="S|PROFILE", help="release delay of edge-run (default 0)")
    p.add_argument(
        "--odometry-noise", choices=tuple(LEVELS), default="none", help="odometry drift in edge-hil (default none)"
    )
    p.add_argument(
        "--speed-limit",
        type=float,
        metavar="MPS",
        help=f"forward speed limit (default: the robot file's; untrained weights: {UNTRAINED_MPS})",
    )
    p.add_argument("--robot", choices=tuple(ROBOTS), default=GO2.name, help=f"robot to drive (default {GO2.name})")
    p.add_argument("--domain", type=int, metavar="N", help="DDS domain of a robot with DDS (default: a free one)")
    p.add_argument("--keep-logs", action="store_true", help="keep the flight logs (about 0.5 GiB an hour)")
    p.add_argument(
        "--to-the-end", action="store_true", help="drive on although a budget line failed that no later leg can mend"
    )
    p.add_argument("--resume", action="store_true", help="continue the soak in --out for the remaining time")
    p.add_argument("--json", metavar="FILE|-", help="write the result as JSON")
    return p


def parse_seconds(text: str) -> float:
    """Parse a time such as 90s, 10m, 1.5h, 1d or 90 to seconds. Raises argparse.ArgumentTypeError."""
    match = re.fullmatch(r"(\d+(?:\.\d+)?)([smhd]?)", text, re.ASCII)
    if match is None:
        raise argparse.ArgumentTypeError(f"expected a time such as 90s, 10m or 1h, found {text!r}")
    return float(match[1]) * _UNITS_S[match[2] or "s"]


@command_line("edge-soak")
def main(argv: Sequence[str] | None = None) -> int:
    """Run the command and return its exit code (see EXAMPLES)."""
    args = parser().parse_args(argv)
    try:
        check_result_target(args.json)
        options = options_of(args)
        menus = {"none": None, "default": DEFAULT_MENU}
        menu_file = menus.get(args.faults, Path(args.faults))
        menu = None if menu_file is None else load_menu(menu_file).for_robot(ROBOTS[args.robot])
        budget = applicable(load_budget(args.budget or DEFAULT_BUDGET), faults=menu is not None)
        soak = (SoakFolder.resume if args.resume else SoakFolder.create)(args.out.absolute(), options)
    except ArtifactError as error:
        return _report_error(error, EXIT_REFUSED)
    except (SoakInputError, SceneError, ValueError, OSError) as error:
        return _report_error(error, EXIT_BAD_INPUT)
    if not options.trained:
        _print(
            "the weights of these artifacts are untrained: the robot will move but not navigate; "
            f"speed limit {options.speed_mps:g} m/s"
        )
    with stop_signals() as stop:
        failure = ""

        def lost() -> str | None:
            return None if args.to_the_end else lost_budget(soak, budget)

        try:
            with Progress("edge-soak: ", period_s=STATUS_PERIOD_S) as progress:
                finished = run_legs(
                    soak, options, menu, stopped=lambda: bool(stop), show_status=progress.show, log=progress.log,
                    lost=lost, keep_logs=args.keep_logs,
                )  # fmt: skip
        except (StepError, ValueError) as error:
            finished, failure = False, str(error)
        result = soak_result(soak, options, budget, menu, finished=finished)
        write_result(str(soak.path / "result.json"), result)
        write_result(args.json, result)
        _print(str(write_report(soak, result)))
        if args.json != "-":
            sys.stdout.write(summary_lines(result))
    if failure:
        return _report_error(failure, EXIT_CHECK_FAILED)
    if not finished and not stop:
        return _report_error(f"{lost()}; drive on with --resume --to-the-end", EXIT_CHECK_FAILED)
    if not finished:
        return _report_error(f"interrupted after {soak.elapsed_s:.0f} s; continue with --resume", EXIT_INTERRUPTED)
    return exit_code(result)


def exit_code(result: Mapping[str, Any]) -> int:
    """Return the exit code of a finished soak and print the undecided budget lines; undecided counts as failed."""
    undecided = [line for line in result["budget"] if line["verdict"] == UNDECIDED]
    if without := [line["measure"] for line in undecided if line["found"]["value"] is None]:
        _print(f"no data: {', '.join(without)}")
    if near := [line["measure"] for line in undecided if line["found"]["value"] is not None]:
        _print(f"too little data: {', '.join(near)}")
    return EXIT_DONE if result["verdict"] == PASS else EXIT_CHECK_FAILED


def options_of(args: argparse.Namespace) -> SoakOptions:
    """Build the options from the arguments. Raises ArtifactError, SoakInputError, SceneError or ValueError."""
    artifacts = load_artifacts(args.artifacts.absolute())
    scenes = tuple(args.scene or ("hospital",))
    for scene in scenes:
        load_scene(scene)
    limit_mps = args.speed_limit
    if limit_mps is None and not artifacts.trained:
        limit_mps = UNTRAINED_MPS
    if limit_mps is not None and not 0.02 <= limit_mps <= 1.5:
        raise SoakInputError(f"--speed-limit: expected 0.02 to 1.5 m/s, found {limit_mps}")
    return SoakOptions(
        artifacts=args.artifacts.absolute(),
        manifest_sha256=artifacts.manifest_sha256,
        trained=artifacts.trained,
        scenes=scenes,
        people=args.people,
        seed=args.seed,
        duration_s=args.duration,
        leg_s=args.leg,
        speed_mps=limit_mps or load_robot_config(ROBOTS[args.robot].file).limits.vx_max_mps,
        speed_limit_mps=limit_mps,
        mode=args.mode,
        release_delay=args.release_delay,
        odometry_noise=args.odometry_noise,
        domain=free_domain() if args.domain is None else args.domain,
        robot=args.robot,
        faults=args.faults,
    )


def summary_lines(result: Mapping[str, Any]) -> str:
    """Format the verdict and the budget's lines for the terminal."""
    rows = []
    for line in result["budget"]:
        limit = f"<= {line['max']:g}" if "max" in line else f">= {line['min']:g}"
        value = line["found"]["value"]
        found = "–" if value is None else f"{value:g} {line['found']['unit']}"
        why = f"  ({line['why']})" if "why" in line else ""
        rows.append(f"{line['verdict']:<10}{line['measure']:<38}{found:>18}  {limit}{why}")
    legs = result["legs"]
    tasks, reached = sum(leg["tasks"] for leg in legs), sum(leg["reached"] for leg in legs)
    rows.append(
        f"{result['verdict']}: {result['elapsed_s']:.0f} s in {len(legs)} legs, {reached} of {tasks} tasks reached, "
        f"{sum(leg['stops'] for leg in legs)} stops, {sum(leg['faults'] for leg in legs)} faults"
    )
    return "\n".join(rows) + "\n"


def _print(line: str) -> None:
    sys.stderr.write(f"edge-soak: {line}\n")
    sys.stderr.flush()


def _report_error(message: object, code: int) -> int:
    _print(str(message))
    return code


if __name__ == "__main__":
    sys.exit(main())
