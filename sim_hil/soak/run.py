"""A whole soak: legs until the time is over, a folder that survives a kill, and a verdict."""

from __future__ import annotations

import json
import shutil
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np

from edge.core.cli import write_whole
from edge.core.stats import percentiles
from edge.flightlog.recorder import space_refusal
from firmware_bridge.system.input_file import read_json
from sim_hil.protocols.fault_socket import FaultError
from sim_hil.realtime.children import StepError
from sim_hil.realtime.robots import ROBOTS
from sim_hil.realtime.stack import StackOptions
from sim_hil.realtime.truth import read_lines
from sim_hil.scene.scene import Vec3, load_scene
from sim_hil.soak.analysis import ANALYSIS, analyse, keep_moments
from sim_hil.soak.arguments import SHORTEST_LEG_S
from sim_hil.soak.faults import FaultMenu, SoakInputError
from sim_hil.soak.leg import LEG, SAMPLES, Leg, LegOptions
from sim_hil.soak.tasks import Journey
from sim_hil.soak.verdict import FAIL, FAILED_LEG, PASS, UNDECIDED, BudgetLine, is_failed, is_lost, judge, measures

CONFIG: Final = "config.json"
LEGS: Final = "legs"
FAILED_LEGS: Final = 3
"""Number of consecutive failed legs that ends the soak, because retrying does not help."""

PrintLine = Callable[[str], None]


@dataclass(frozen=True)
class SoakOptions:
    """Options of a soak; a resumed soak must have the same ones except for the duration."""

    artifacts: Path
    manifest_sha256: str
    trained: bool
    scenes: tuple[str, ...]
    people: int
    seed: int
    duration_s: float
    leg_s: float
    speed_mps: float
    speed_limit_mps: float | None
    mode: str
    release_delay: str
    odometry_noise: str
    domain: int
    robot: str
    """Name of the robot (sim_hil.realtime.robots)."""
    faults: str
    """Value of --faults: default, none, or the path of a fault menu."""

    def config(self) -> dict[str, Any]:
        """Return the options that a resumed soak must share."""
        left_out = ("duration_s", "artifacts", "domain")
        kept = {key: value for key, value in self.__dict__.items() if key not in left_out}
        return {**kept, "scenes": list(self.scenes)}


@dataclass
class SoakFolder:
    """Folder of a soak with the analyses of its finished legs."""

    path: Path
    legs: list[dict[str, Any]] = field(default_factory=list)

    @property
    def elapsed_s(self) -> float:
        """Total duration of the legs so far, s, without those that failed."""
        return float(sum(leg["elapsed_s"] for leg in self.legs if not is_failed(leg)))

    def folder(self, number: int) -> Path:
        """Return the folder of a leg; legs are numbered from 1."""
        return self.path / LEGS / f"{number:03d}"

    def samples(self) -> list[list[dict[str, Any]]]:
        """Return the process samples of every leg."""
        return [list(read_lines(self.folder(leg["leg"]["number"]) / SAMPLES)) for leg in self.legs]

    @staticmethod
    def create(path: Path, options: SoakOptions) -> SoakFolder:
        """Create a folder. Raises SoakInputError if it already contains a soak, or if the disk is too full."""
        if (path / CONFIG).exists():
            raise SoakInputError(f"--out {path}: contains a soak; continue it with --resume or name another folder")
        _check_disk_space(path)
        (path / LEGS).mkdir(parents=True, exist_ok=True)
        write_whole(path / CONFIG, json.dumps(options.config(), indent=1) + "\n")
        return SoakFolder(path)

    @staticmethod
    def resume(path: Path, options: SoakOptions) -> SoakFolder:
        """Open the folder of a soak with the same options; analyse unfinished legs. Raises SoakInputError."""
        try:
            before = read_json(path / CONFIG)
        except (OSError, ValueError) as error:
            raise SoakInputError(f"--resume: {path} contains no soak to continue ({error})") from error
        if not isinstance(before, dict):
            raise SoakInputError(
                f"--resume: {path / CONFIG}: expected an object, found {type(before).__name__}; restore the file, or "
                "begin a new soak in another folder"
            )
        now = options.config()
        differ = [key for key in now if before.get(key) != now[key]]
        if differ:
            key = differ[0]
            raise SoakInputError(f"--resume: {path} was begun with {key} {before.get(key)!r}, found {now[key]!r}")
        found = SoakFolder.open(path)
        if options.duration_s - found.elapsed_s >= SHORTEST_LEG_S:
            _check_disk_space(path)
        return found

    @staticmethod
    def open(path: Path) -> SoakFolder:
        """Open a folder and analyse unfinished legs. Raises OSError, or SoakInputError for damaged files."""
        found = SoakFolder(path)
        for folder in sorted((path / LEGS).iterdir()):
            try:
                if (folder / ANALYSIS).exists():
                    leg = read_json(folder / ANALYSIS)
                elif (folder / LEG).exists() and (folder / SAMPLES).exists():
                    leg = analyse(folder)  # the soak was killed during this leg
                else:
                    shutil.rmtree(folder)  # killed before the first sample
                    continue
                # Whatever the verdict reads is read once here, where an error can name the folder.
                _leg_result(leg)
                measures([leg], [list(read_lines(folder / SAMPLES))])
            except (ValueError, LookupError, TypeError, AttributeError, ArithmeticError) as error:
                raise SoakInputError(
                    f"{folder}: expected the files of a leg, found damaged ones ({error!r}); "
                    "restore them, or move this folder away and resume"
                ) from error
            found.legs.append(leg)
        return found


def _check_disk_space(path: Path) -> None:
    """Check that a runner could record flight logs under `path`, which may not exist yet. Raises SoakInputError."""
    existing = next(folder for folder in (path, *path.parents) if folder.exists())
    refusal = space_refusal(existing / "flight.mcap")
    if refusal is not None:
        raise SoakInputError(f"--out {path}: {refusal}")


def journey_of_leg(options: SoakOptions, scene: str, number: int) -> Journey:
    """Return the sequence of a leg's tasks. Raises ValueError for a scene without free space or landmarks."""
    body = ROBOTS[options.robot].hil_robot
    return Journey(load_scene(scene), options.seed, number, options.speed_mps, body, options.people)


def run_legs(
    soak: SoakFolder,
    options: SoakOptions,
    menu: FaultMenu | None,
    *,
    stopped: Callable[[], bool],
    show_status: PrintLine,
    log: PrintLine,
    lost: Callable[[], str | None] = lambda: None,
    keep_logs: bool = False,
) -> bool:
    """Run legs until the time is over; return False if `stopped` or `lost` ended it.

    `show_status` gets a status line a few times a second, `log` a line per leg. `lost`: asked before each leg; why
    no later leg can meet the budget. Raises StepError after FAILED_LEGS.
    """
    failed = 0
    while not stopped():
        left_s = options.duration_s - soak.elapsed_s
        if left_s < SHORTEST_LEG_S:
            return True
        if (reason := lost()) is not None:
            log(reason)
            return False
        number = 1 + max((leg["leg"]["number"] for leg in soak.legs), default=0)
        folder = soak.folder(number)
        folder.mkdir(parents=True, exist_ok=True)
        scene = options.scenes[(number - 1) % len(options.scenes)]
        journey = journey_of_leg(options, scene, number)
        stack = _stack_options(options, number, folder, scene, journey.begin(), faults=menu is not None)
        leg_options = LegOptions(number, options.seed, min(options.leg_s, left_s), options.speed_mps, stack)
        leg = Leg(leg_options, journey, menu, stopped=stopped, show_status=show_status)
        try:
            why = leg.run()
            failed = 0
        except (StepError, FaultError) as error:
            failed += 1
            why = f"{FAILED_LEG}{error}"
            if failed == FAILED_LEGS:
                raise StepError(f"{FAILED_LEGS} legs in a row failed, the last one: {error}") from error
        log(f"leg {number} ended: {why}; {leg.reached} of {leg.tasks} tasks reached, {leg.stops} stops")
        analysis = analyse(folder)
        keep_moments(folder, analysis)
        soak.legs.append(analysis)
        if not keep_logs:
            for flight_log in folder.glob("flight-*.mcap"):
                flight_log.unlink()
    return False


def _stack_options(
    options: SoakOptions, number: int, folder: Path, scene: str, start: Vec3, *, faults: bool
) -> StackOptions:
    return StackOptions(
        folder=folder,
        artifacts=options.artifacts,
        scene=scene,
        start=start,
        people=options.people,
        seed=int(np.random.default_rng((options.seed, 63, number)).integers(2**31)),
        domain=options.domain,
        robot=ROBOTS[options.robot],
        mode=options.mode,
        release_delay=options.release_delay,
        odometry_noise=options.odometry_noise,
        speed_limit_mps=options.speed_limit_mps,
        faults=faults,
        instructions=True,
    )


def lost_budget(soak: SoakFolder, budget: Sequence[BudgetLine], menu: FaultMenu | None) -> str | None:
    """Return in one line which budget line no later leg can meet; None while all can be met."""
    found = measures(soak.legs, soak.samples(), menu)
    judged = [judge(line, found[line.measure]) for line in budget]
    lost = [f"{line['measure']} is {line['found']['value']:g}, {limit_text(line)}" for line in judged if is_lost(line)]
    return f"the budget is lost: {'; '.join(lost)}" if lost else None


def limit_text(line: Mapping[str, Any]) -> str:
    """Return the limit of a judged budget line."""
    return f"at most {line['max']:g}" if "max" in line else f"at least {line['min']:g}"


def soak_result(
    soak: SoakFolder, options: SoakOptions, budget: Sequence[BudgetLine], menu: FaultMenu | None, *, finished: bool
) -> dict[str, Any]:
    """Return the result for `--json`; `coverage`: injections of every fault of the menu."""
    names = [] if menu is None else [fault.name for fault in menu.faults]
    found = measures(soak.legs, soak.samples(), menu)
    injected = Counter(fault["name"] for leg in soak.legs for fault in leg["faults"])
    judged = [judge(line, found[line.measure]) for line in budget]
    verdicts = {line["verdict"] for line in judged}
    lives = [life for leg in soak.legs for life in leg["lives"]]
    ends = [end for leg in soak.legs for end in leg["life_ends"] if end["cause"] != "leg"]
    reasons: dict[str, int] = {}
    for life in lives:
        for name, count in life["reasons"].items():
            reasons[name] = reasons.get(name, 0) + count
    generations = [value for life in lives for value in life["generation_ms"]]
    watts = [row[1] for life in lives for row in life["power"]]
    sources = sorted({row[2] for life in lives for row in life["power"]})
    return {
        "verdict": FAIL if FAIL in verdicts else PASS if verdicts == {PASS} else UNDECIDED,
        "finished": finished,
        "elapsed_s": round(soak.elapsed_s, 1),
        "asked_s": options.duration_s,
        "budget": judged,
        "measures": {name: measure.as_json() for name, measure in found.items()},
        "control": {
            "ticks": sum(life["ticks"] for life in lives),
            "missed": sum(life["missed"] for life in lives),
            "tick_ms": percentiles([v for life in lives for v in life["tick_ms"]], "p50", "p99", "p999", "max"),
            "reasons": reasons,
        },
        "reasoning": {
            "generations": len(generations),
            "generation_ms": percentiles(generations, "p50", "p99", "max"),
        },
        "delay_s": percentiles([v for life in lives for v in life["delay_s"] if v is not None], "p50", "p99", "max"),
        "power_w": {
            "mean": found["power_w.mean"].value,
            **percentiles(watts, "p99"),
            "source": " and ".join(sources) or None,
        },
        "coverage": {name: injected[name] for name in names},
        "faults": [end["cause"] or f"ended with code {end['code']}" for end in ends],
        "legs": [_leg_result(leg) for leg in soak.legs],
        "options": {**options.config(), "artifacts": str(options.artifacts)},
        "tagged": "measured",
    }


def _leg_result(leg: Mapping[str, Any]) -> dict[str, Any]:
    tasks = [task for task in leg["tasks"] if task["end"] != "cut"]
    return {
        "number": leg["leg"]["number"],
        "machine": leg["leg"].get("machine", "unknown"),
        "scene": leg["leg"]["stack"]["scene"],
        "elapsed_s": leg["elapsed_s"],
        "why": leg["why"],
        "tasks": len(tasks),
        "reached": sum(task["success"] for task in tasks),
        "collided": sum(bool(task["collisions"]) for task in tasks),
        "stops": sum(end["cause"] != "leg" for end in leg["life_ends"]),
        "faults": len(leg["faults"]),
    }
