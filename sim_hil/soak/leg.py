"""One leg of a soak: one stack in one scene, consecutive tasks without a restart, faults, and a sample every second.

A runner that ends (permanent stop or killed process) is counted and restarted with its bridge. A stuck robot ends the
leg. All events are written to the leg's folder at once, so that a killed soak loses nothing.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict, dataclass
from math import hypot
from pathlib import Path
from typing import Any, Final, TextIO

from edge.core.cli import EXIT_DONE, EXIT_INTERRUPTED, EXIT_REFUSED
from edge.core.device import read_device
from edge.run.say import SayError, say
from firmware_bridge.system.input_file import read_json
from sim_hil.processes.process_sampler import ProcessSampler
from sim_hil.protocols.fault_socket import FaultError
from sim_hil.realtime.children import StepError
from sim_hil.realtime.stack import Stack, StackOptions
from sim_hil.realtime.truth import TruthTail
from sim_hil.soak.faults import FaultMenu, FaultSchedule, Injector
from sim_hil.soak.tasks import Journey, SoakTask, TaskRun
from sim_hil.soak.verdict import FAILED_LEG, SHORTEST_S, WARM_UP_S

SAMPLE_NS: Final = 1_000_000_000
POLL_S: Final = 0.05
ARM_TIMEOUT_S: Final = 90.0
RETRY_NS: Final = 1_000_000_000
"""Pause before an instruction is sent again."""
FAULT_AFTER_NS: Final = 3_000_000_000
"""A stop within this time after a fault's end or a contact is attributed to it."""
STUCK_LIVES: Final = 3
"""Number of consecutive runners that end within STUCK_M of each other for the robot to count as stuck."""
STUCK_M: Final = 0.5
CONTACT: Final = "contact"
CONTACT_STOPS: Final = frozenset(
    ("odometry-stays-frozen", "robot-stays-blocked", "odometry-speed-mismatch", "tipped-over")
)
"""Faults that stop a robot after a contact."""
JUDGED_LIFE_S: Final = WARM_UP_S + SHORTEST_S + 60.0
"""Life of a runner, s, from which its growth can be judged; faults that end it are put off until then."""
CLEAN: Final = (EXIT_DONE, EXIT_INTERRUPTED)
"""Exit codes of a process that ended because it was asked to."""
SAMPLES, EVENTS, LEG = "samples.jsonl", "events.jsonl", "leg.json"


class _StoppedError(Exception):
    """The user requested the end."""


@dataclass(frozen=True)
class LegOptions:
    """Options of a leg: its number from 1, its stack and its duration."""

    number: int
    seed: int
    duration_s: float
    speed_mps: float
    stack: StackOptions


class Leg:
    """One leg; `show_status` gets a status line every second."""

    def __init__(
        self,
        options: LegOptions,
        journey: Journey,
        menu: FaultMenu | None,
        *,
        stopped: Callable[[], bool],
        show_status: Callable[[str], None],
    ) -> None:
        self.options = options
        self._journey = journey
        self._planner = ThreadPoolExecutor(1)
        self._menu = menu
        self._stopped = stopped
        self._show_status = show_status
        self._stack = Stack(options.stack)
        self._truth = TruthTail(self._stack.trace)
        self._sampler = ProcessSampler()
        self._injector: Injector | None = None
        self._task: TaskRun | None = None
        self._touched_ns, self._explained = 0, ""
        self._begin_ns = 0
        self._driven_ns: int | None = None
        self._sampled_ns = 0
        self._armed = False
        self._lives: list[tuple[float, float]] = []
        self.tasks = self.reached = self.stops = 0

    def run(self) -> str:
        """Run the leg; return why it ended: duration, stopped, stuck, no-task.

        Raises StepError, OSError or FaultError.
        """
        folder = self.options.stack.folder
        stack = asdict(self.options.stack)
        about = {
            **asdict(self.options),
            "machine": f"{os.cpu_count()} cores, {read_device('CPUExecutionProvider').device}",
            "stack": {
                **stack,
                "folder": folder.name,
                "artifacts": str(stack["artifacts"]),
                "robot": self.options.stack.robot.name,
            },
        }
        events, samples = (folder / name for name in (EVENTS, SAMPLES))
        # The stack before the files: it removes its sockets also where a file of the leg cannot be written.
        with self._planner, self._stack, events.open("a") as self._events, samples.open("a") as self._samples:
            (folder / LEG).write_text(json.dumps(about, indent=1) + "\n", encoding="utf-8")
            self._begin_ns = time.monotonic_ns()
            self._note("leg_begin", scene=self.options.stack.scene, people=self.options.stack.people)
            if self._menu is not None:
                schedule = FaultSchedule(self._menu, self.options.seed, self.options.number)
                self._injector = Injector(self._stack, schedule, self._note)
            try:
                self._stack.watch_stalls()
                self._stack.start_robot(self._wait)
                why = self._lives_of_runners()
            except _StoppedError:
                why = "stopped"
            except (StepError, FaultError) as error:
                self._note("leg_end", why=f"{FAILED_LEG}{str(error).splitlines()[0]}")
                raise
            self._end_task("cut")
            self._end_processes()
            self._note("leg_end", why=why)
        return why

    def _end_processes(self) -> None:
        """End the leg's processes; one that crashed or did not end when asked counts as a stop."""
        explanation = self._explanation()
        for name in ("runner", "bridge", "robot"):
            if (code := self._stack.end(name)) is None:
                continue
            if code not in CLEAN:
                result = self._stack.result(f"edge-run-{self._stack.runs}")
                own, raised = _end_of_run(result) if name == "runner" else ("", set())
                why = own or f"the {name} ended with code {code} at the end of the leg"
                explained = explained_end(explanation, "", raised, refused=False)
                self._note("life_end", run=self._stack.runs, code=code, cause=why, explained=explained)
                self.stops += 1
            elif name == "runner":
                self._note("life_end", run=self._stack.runs, code=code, cause="leg", explained="leg")

    def _lives_of_runners(self) -> str:
        while True:
            task = self._next_task()
            if task is None:
                return "no-task"
            self._stack.start_bridge(self._wait)
            self._stack.start_runner(task.instruction)
            self._note("life_begin", run=self._stack.runs)
            self._await_arming()
            if self._armed:
                self._put_off_stops(time.monotonic_ns())
                self._begin_task(task)
            why = self._drive() if self._armed else None
            if why is not None:
                return why
            if self._life_over():
                return "stuck"

    def _put_off_stops(self, now_ns: int) -> None:
        """Let a new runner live until its growth can be judged, where the leg is long enough for that."""
        if self._injector is not None:
            enough = self.left_s(now_ns) > JUDGED_LIFE_S
            self._injector.stops_from_ns = now_ns + round(JUDGED_LIFE_S * 1e9) if enough else now_ns

    def _await_arming(self) -> None:
        runner = self._stack.runner
        assert runner is not None
        deadline_ns = time.monotonic_ns() + round(ARM_TIMEOUT_S * 1e9)
        while runner.running and not self._stack.armed():
            if time.monotonic_ns() > deadline_ns:
                raise runner.failure(f"not armed within {ARM_TIMEOUT_S:g} s")
            self._wait()
            time.sleep(POLL_S)
        self._armed = self._stack.armed()
        if self._armed:
            self._driven_ns = self._driven_ns or time.monotonic_ns()
            self._note("armed", run=self._stack.runs)

    def _drive(self) -> str | None:
        """Drive until the runner or the bridge ends (returns None) or the leg ends (returns why)."""
        runner, bridge = self._stack.runner, self._stack.bridge
        assert runner is not None and bridge is not None
        planned: Future[SoakTask | None] | None = None
        pending: SoakTask | None = None
        send_ns = 0
        while runner.running and bridge.running:
            self._wait()
            end = self._read_truth()
            now_ns = time.monotonic_ns()
            if self._injector is not None:
                self._injector.step(now_ns)
            if self.left_s(now_ns) <= 0:
                return "duration"
            if end is not None:
                self._end_task(end)
                planned = self._plan_task()
            if planned is not None and planned.done():
                pending, planned, send_ns = planned.result(), None, now_ns
                if pending is None:
                    return "no-task"
            if pending is not None and now_ns >= send_ns:
                if self._send_instruction(pending):
                    self._begin_task(pending)
                    pending = None
                send_ns = time.monotonic_ns() + RETRY_NS  # a runner too busy to answer keeps driving
            time.sleep(POLL_S)
        return None

    def _send_instruction(self, task: SoakTask) -> bool:
        try:
            say(self._stack.instructions, task.instruction)
        except (SayError, OSError) as error:
            # If the runner is ending, the check of its process finds out why.
            self._note("not_told", why=str(error))
            return False
        return True

    def _life_over(self) -> bool:
        """Record a runner that ended by itself; return whether the robot is stuck."""
        self._read_truth()
        explained = self._explanation()
        during = None if self._injector is None else self._injector.active
        self._end_task("stopped")
        bridge = self._stack.bridge
        bridge_died = bridge is not None and not bridge.running
        code = self._stack.end("runner")  # takes a little longer if the bridge was killed
        self._stack.end("bridge")
        cause, raised = _end_of_run(self._stack.result(f"edge-run-{self._stack.runs}"))
        refused = not self._armed and code == EXIT_REFUSED
        explained = self._explained = explained_end(explained, self._explained, raised, refused=refused)
        about = {"cause": cause, "explained": explained, "during": during, "bridge_died": bridge_died}
        self._note("life_end", run=self._stack.runs, code=code, **about)
        self.stops += 1
        if self._injector is not None:
            self._injector.clear()
        self._armed = False
        pose = self._truth.newest
        assert pose is not None
        self._lives.append((pose.x_m, pose.y_m))
        last = self._lives[-STUCK_LIVES:]
        return len(last) == STUCK_LIVES and all(hypot(x - last[-1][0], y - last[-1][1]) < STUCK_M for x, y in last)

    def _explanation(self) -> str:
        """Return the cause of a stop: a fault that should end the run, a contact, or "" if unexplained."""
        now_ns, injector = time.monotonic_ns(), self._injector
        newest = None if injector is None else injector.newest
        stops = newest is not None and newest.fault.expect == "stop"
        if injector is not None and newest is not None and stops and now_ns - injector.newest_ns < FAULT_AFTER_NS:
            return newest.fault.name
        return CONTACT if now_ns - self._touched_ns < FAULT_AFTER_NS else ""

    def _next_task(self) -> SoakTask | None:
        while self._truth.newest is None:
            self._read_truth()
            self._wait()
            time.sleep(POLL_S)
        planned = self._plan_task()
        while not planned.done():
            self._wait()
            time.sleep(POLL_S)
        return planned.result()

    def _plan_task(self) -> Future[SoakTask | None]:
        """Begin to plan the next task from the robot's pose: samples and faults must not wait the seconds it takes."""
        self._read_truth()
        pose = self._truth.newest
        assert pose is not None
        return self._planner.submit(self._journey.next, (pose.x_m, pose.y_m, pose.theta_rad))

    def _begin_task(self, task: SoakTask) -> None:
        self._task = TaskRun(task, time.monotonic_ns())
        self._note("task_begin", task=asdict(task), run=self._stack.runs)

    def _end_task(self, end: str) -> None:
        if self._task is None:
            return
        outcome = self._task.outcome(end)
        self._task = None
        self._note("task_end", **outcome)
        if end != "cut":
            self.tasks += 1
            self.reached += outcome["success"]

    def _read_truth(self) -> str | None:
        """Read the new ground truth; return why the task is over, None if it is not."""
        end: str | None = None
        for pose in self._truth.update():
            if pose.touching:
                self._touched_ns = pose.t_ns
            if self._task is not None and end is None:
                end = self._task.add(pose)
        return end

    def _wait(self) -> None:
        """Check for a requested end and for the health of the robot's side, and take a sample when due."""
        if self._stopped():
            raise _StoppedError
        robot = self._stack.robot
        if robot is not None and not robot.running:
            raise StepError(f"the robot's side ended with exit code {robot.process.returncode}, see {robot.log}")
        now_ns = time.monotonic_ns()
        if now_ns - self._sampled_ns >= SAMPLE_NS:
            self._sampled_ns = max(self._sampled_ns + SAMPLE_NS, now_ns - SAMPLE_NS // 2)
            self._sample(now_ns)

    def _sample(self, now_ns: int) -> None:
        if self._task is None:  # otherwise _drive reads the ground truth
            self._read_truth()
        pose = self._truth.newest
        sample: dict[str, Any] = {
            "t_ns": now_ns,
            "elapsed_s": round((now_ns - self._begin_ns) / 1e9, 3),
            "run": self._stack.runs,
            "armed": self._armed,
            "task": None if self._task is None else self._task.task.number,
            "fault": None if self._injector is None else self._injector.active,
            "pose": None if pose is None else [pose.x_m, pose.y_m, pose.theta_rad],
            "processes": self._sampler.sample(self._stack.processes()),
        }
        _append(self._samples, sample)
        self._show_status(
            f"leg {self.options.number}, {max(0.0, self.left_s(now_ns)):.0f} s left · "
            f"{self.reached} of {self.tasks} tasks reached · {self.stops} stops"
            + (f" · {sample['fault']}" if sample["fault"] else "")
        )

    def left_s(self, now_ns: int) -> float:
        """Return the remaining time, s; a leg's time begins when its first runner drives."""
        begun_ns = now_ns if self._driven_ns is None else self._driven_ns
        return self.options.duration_s - (now_ns - begun_ns) / 1e9

    def _note(self, kind: str, **fields: Any) -> None:
        _append(self._events, {"t_ns": time.monotonic_ns(), "kind": kind, **fields})


def explained_end(explained: str, before: str, raised: set[str], *, refused: bool) -> str:
    """Return the explanation of a runner's end, "" without one.

    `explained`: what happened shortly before; `before`: the explanation of the end before; `raised`: the runner's
    faults; `refused`: whether its arming was refused. A contact explains a fall. A robot that fell lies or leans there
    until somebody lifts it, and no later runner may arm it.
    """
    if refused:
        return explained or (CONTACT if before == CONTACT else "")
    return explained if explained != CONTACT or raised & CONTACT_STOPS else ""


def _end_of_run(result: Path) -> tuple[str, set[str]]:
    """Return the runner's own reason for its end and all faults that it raised; empty if it was killed."""
    try:
        content = read_json(result)
        faults, raised = content["faults"], set(content["control"]["faults"])
    except (OSError, ValueError, KeyError):
        return "", set()
    return (str(faults[0]) if faults else ""), raised


def _append(file: TextIO, content: dict[str, Any]) -> None:
    """Append one JSON line; flushed, so that the file stays complete if the process is killed."""
    file.write(json.dumps(content) + "\n")
    file.flush()
