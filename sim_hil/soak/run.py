"""A soak as the command asks for it: legs until its time is over, a folder that survives a kill, a verdict."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np

from edge.core.cli import write_whole
from edge.core.stats import percentiles
from edge.flightlog.recorder import space_refusal
from sim_hil.protocols.fault_client import FaultError
from sim_hil.realtime.children import StepError
from sim_hil.realtime.stack import COMMANDS, StackOptions
from sim_hil.realtime.truth import read_lines
from sim_hil.scene.scene import load_scene
from sim_hil.soak.drive.journey import Journey
from sim_hil.soak.drive.leg import LEG, SAMPLES, Leg, LegOptions
from sim_hil.soak.drive.schedule import FaultMenu, SoakInputError
from sim_hil.soak.verdict.analysis import ANALYSIS, analyse
from sim_hil.soak.verdict.budget import FAIL, PASS, UNDECIDED, BudgetLine, Judgement, judge
from sim_hil.soak.verdict.measures import measures

CONFIG: Final = "config.json"
LEGS: Final = "legs"
SHORTEST_LEG_S: Final = 15.0
FAILED_LEGS: Final = 3
"""So many legs in a row that fail end the soak: something is wrong that another try does not mend."""

Tell = Callable[[str], None]


@dataclass(frozen=True)
class SoakOptions:
    """What a soak was asked for; a resumed one must match all but its duration."""

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
    faults: str
    """The menu's name, as it was given."""

    def __post_init__(self) -> None:
        if not SHORTEST_LEG_S <= self.duration_s <= 30 * 86_400:
            raise SoakInputError(f"--duration: expected {SHORTEST_LEG_S:g} s to 30 days, found {self.duration_s:g} s")
        if not SHORTEST_LEG_S <= self.leg_s <= 86_400:
            raise SoakInputError(f"--leg: expected {SHORTEST_LEG_S:g} s to a day, found {self.leg_s:g} s")
        if self.people < 0 or self.seed < 0 or not self.scenes:
            raise SoakInputError("--people and --seed: expected 0 or more, and one scene or more")

    def config(self) -> dict[str, Any]:
        """What a resumed run must have in common with this one."""
        left_out = ("duration_s", "artifacts", "domain")
        kept = {key: value for key, value in self.__dict__.items() if key not in left_out}
        return {**kept, "scenes": list(self.scenes)}


@dataclass
class SoakFolder:
    """The folder of a soak and what its legs have come to."""

    path: Path
    legs: list[dict[str, Any]] = field(default_factory=list)

    @property
    def elapsed_s(self) -> float:
        """Time that the legs have taken so far."""
        return float(sum(leg["elapsed_s"] for leg in self.legs))

    def folder(self, number: int) -> Path:
        """Of a leg, counted from 1."""
        return self.path / LEGS / f"{number:03d}"

    def samples(self) -> list[list[dict[str, Any]]]:
        """Of every leg."""
        return [list(read_lines(self.folder(leg["leg"]["number"]) / SAMPLES)) for leg in self.legs]

    @staticmethod
    def create(path: Path, options: SoakOptions) -> SoakFolder:
        """A new one; raises SoakInputError where there is one already, or no room to record to."""
        if (path / CONFIG).exists():
            raise SoakInputError(f"--out {path}: holds a soak; continue it with --resume or name another folder")
        _need_room(path)
        (path / LEGS).mkdir(parents=True, exist_ok=True)
        write_whole(path / CONFIG, json.dumps(options.config(), indent=1) + "\n")
        return SoakFolder(path)

    @staticmethod
    def resume(path: Path, options: SoakOptions) -> SoakFolder:
        """One that was begun with the same options; legs without an analysis get it now. Raises SoakInputError."""
        try:
            before = json.loads((path / CONFIG).read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise SoakInputError(f"--resume: {path} holds no soak to continue ({error})") from error
        now = options.config()
        differ = [key for key in now if before.get(key) != now[key]]
        if differ:
            key = differ[0]
            raise SoakInputError(f"--resume: {path} was begun with {key} {before.get(key)!r}, found {now[key]!r}")
        found = SoakFolder.open(path)
        if options.duration_s - found.elapsed_s >= SHORTEST_LEG_S:
            _need_room(path)
        return found

    @staticmethod
    def open(path: Path) -> SoakFolder:
        """All legs of a folder; raises OSError."""
        found = SoakFolder(path)
        for folder in sorted((path / LEGS).iterdir()):
            if (folder / ANALYSIS).exists():
                found.legs.append(json.loads((folder / ANALYSIS).read_text(encoding="utf-8")))
            elif (folder / LEG).exists() and (folder / SAMPLES).exists():
                found.legs.append(analyse(folder))  # its soak was killed
            else:
                shutil.rmtree(folder)  # killed before its first second
        return found


def _need_room(path: Path) -> None:
    """Raises SoakInputError where no runner would be armed with its flight logs under `path`, there already or not."""
    there = next(folder for folder in (path, *path.parents) if folder.exists())
    refusal = space_refusal(there / "flight.mcap")
    if refusal is not None:
        raise SoakInputError(f"--out {path}: {refusal}")


def run_legs(
    soak: SoakFolder,
    options: SoakOptions,
    menu: FaultMenu | None,
    *,
    stopped: Callable[[], bool],
    tell: Tell,
    say: Tell,
    keep_logs: bool = False,
    commands: Mapping[str, Sequence[str]] = COMMANDS,
    after_leg: Callable[[Path, dict[str, Any]], None] = lambda folder, analysis: None,
) -> bool:
    """Legs until the time is over; False when somebody stopped it. Raises StepError when nothing runs at all."""
    failed = 0
    while not stopped():
        left_s = options.duration_s - soak.elapsed_s
        if left_s < SHORTEST_LEG_S:
            return True
        number = 1 + max((leg["leg"]["number"] for leg in soak.legs), default=0)
        folder = soak.folder(number)
        folder.mkdir(parents=True, exist_ok=True)
        leg = _leg(options, number, folder, min(options.leg_s, left_s), menu, stopped, tell, commands)
        try:
            why = leg.run()
            failed = 0
        except (StepError, FaultError) as error:
            failed += 1
            why = f"failed: {error}"
            if failed == FAILED_LEGS:
                raise StepError(f"{FAILED_LEGS} legs in a row have failed, the last one: {error}") from error
        say(f"leg {number} has ended: {why}; {leg.reached} of {leg.tasks} tasks reached, {leg.stops} stops")
        analysis = analyse(folder)
        after_leg(folder, analysis)
        soak.legs.append(analysis)
        if not keep_logs:
            for log in folder.glob("flight-*.mcap"):
                log.unlink()
    return False


def _leg(
    options: SoakOptions,
    number: int,
    folder: Path,
    duration_s: float,
    menu: FaultMenu | None,
    stopped: Callable[[], bool],
    tell: Tell,
    commands: Mapping[str, Sequence[str]],
) -> Leg:
    scene = options.scenes[(number - 1) % len(options.scenes)]
    journey = Journey(load_scene(scene), options.seed, number, options.speed_mps)
    stack = StackOptions(
        folder=folder,
        artifacts=options.artifacts,
        scene=scene,
        start=journey.begin(),
        people=options.people,
        seed=int(np.random.default_rng((options.seed, 63, number)).integers(2**31)),
        domain=options.domain,
        mode=options.mode,
        release_delay=options.release_delay,
        odometry_noise=options.odometry_noise,
        speed_limit_mps=options.speed_limit_mps,
        faults=menu is not None,
        instructions=True,
    )
    return Leg(
        LegOptions(number, options.seed, duration_s, options.speed_mps, stack),
        journey,
        menu,
        stopped=stopped,
        tell=tell,
        commands=commands,
    )


def verdict(judgements: Sequence[Judgement]) -> str:
    """FAIL where a line fails, else UNDECIDED where one could not be judged or there is none, else PASS."""
    found = {judgement.verdict for judgement in judgements}
    return FAIL if FAIL in found else PASS if found == {PASS} else UNDECIDED


def soak_result(
    soak: SoakFolder, options: SoakOptions, budget: Sequence[BudgetLine], *, finished: bool
) -> dict[str, Any]:
    """What `--json` writes (design section 9). Raises SoakInputError for a budget of something unknown."""
    found = measures(soak.legs, soak.samples())
    judgements = judge(budget, found)
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
        "verdict": verdict(judgements),
        "finished": finished,
        "elapsed_s": round(soak.elapsed_s, 1),
        "asked_s": options.duration_s,
        "budget": [judgement.as_json() for judgement in judgements],
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
        "faults": [end["cause"] or f"ended with code {end['code']}" for end in ends],
        "legs": [_leg_result(leg) for leg in soak.legs],
        "options": {**options.config(), "artifacts": str(options.artifacts)},
        "tagged": "measured",
    }


def _leg_result(leg: Mapping[str, Any]) -> dict[str, Any]:
    tasks = [task for task in leg["tasks"] if task["end"] != "cut"]
    return {
        "number": leg["leg"]["number"],
        "scene": leg["leg"]["stack"]["scene"],
        "elapsed_s": leg["elapsed_s"],
        "why": leg["why"],
        "tasks": len(tasks),
        "reached": sum(task["success"] for task in tasks),
        "collided": sum(bool(task["collisions"]) for task in tasks),
        "stops": sum(end["cause"] != "leg" for end in leg["life_ends"]),
        "faults": len(leg["faults"]),
    }
