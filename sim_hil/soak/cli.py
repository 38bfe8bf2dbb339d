"""`edge-soak`: drive task after task for hours in real time with random faults, and judge the measurements."""

from __future__ import annotations

import argparse
import errno
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
    command_line,
    describe_os_error,
    stop_signals,
    write_result,
)
from firmware_bridge.core.config import load_robot_config
from firmware_bridge.system.terminal import one_line
from reporting.progress import Progress
from sim_hil.realtime.children import StepError
from sim_hil.realtime.robots import ROBOTS, free_domain
from sim_hil.scene.scene import SceneError
from sim_hil.soak.arguments import UNTRAINED_MPS, check, parser
from sim_hil.soak.faults import DEFAULT_MENU, SoakInputError, load_menu
from sim_hil.soak.report import write_report
from sim_hil.soak.run import SoakFolder, SoakOptions, journey_of_leg, lost_budget, run_legs, soak_result
from sim_hil.soak.verdict import DEFAULT_BUDGET, PASS, UNDECIDED, applicable, load_budget

STATUS_PERIOD_S: Final = 30.0


@command_line("edge-soak")
def main(argv: Sequence[str] | None = None) -> int:
    """Run the command and return its exit code (see EXAMPLES)."""
    args = parser().parse_args(argv)
    try:
        check(args)
        menus = {"none": None, "default": DEFAULT_MENU}
        menu_file = menus.get(args.faults, Path(args.faults))
        menu = None if menu_file is None else load_menu(menu_file).for_robot(ROBOTS[args.robot])
        budget = applicable(load_budget(args.budget or DEFAULT_BUDGET), faults=menu is not None)
        options = options_of(args)  # last: a task is drawn in every scene
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
            return None if args.to_the_end else lost_budget(soak, budget, menu)

        try:
            with Progress("edge-soak: ", period_s=STATUS_PERIOD_S) as progress:
                finished = run_legs(
                    soak, options, menu, stopped=lambda: bool(stop), show_status=progress.show, log=progress.log,
                    lost=lost, keep_logs=args.keep_logs,
                )  # fmt: skip
        except (StepError, ValueError) as error:
            finished, failure = False, str(error)
        except OSError as error:
            finished, failure = False, describe_os_error(error, f"--out {soak.path}")
        try:
            # Reads the files of every leg, so nothing is written into a folder that was deleted meanwhile.
            result = soak_result(soak, options, budget, menu, finished=finished)
            if not soak.path.is_dir():
                raise FileNotFoundError(errno.ENOENT, "the folder was deleted", str(soak.path))
            write_result(str(soak.path / "result.json"), result)
            write_result(args.json, result)
            _print(str(write_report(soak, result)))
        except OSError as error:
            found = describe_os_error(error, "a file of the soak")
            return _report_error(
                f"--out {soak.path}: expected the soak's files to stay until its end, found: {found}; "
                "start again with another folder",
                EXIT_CHECK_FAILED,
            )
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
    limit_mps = args.speed_limit
    if limit_mps is None and not artifacts.trained:
        limit_mps = UNTRAINED_MPS
    options = SoakOptions(
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
    for scene in dict.fromkeys(scenes):
        # Refused now, not hours later when its leg begins.
        journey_of_leg(options, scene, 1).begin()
    return options


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
    sys.stderr.write(f"edge-soak: {one_line(line)}\n")
    sys.stderr.flush()


def _report_error(message: object, code: int) -> int:
    _print(str(message))
    return code


if __name__ == "__main__":
    sys.exit(main())
