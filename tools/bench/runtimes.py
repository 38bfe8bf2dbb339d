"""Compares `cpu` artifacts with ONNX Runtime GenAI, OpenVINO, llama.cpp, PyTorch: same weights, shapes, threads.

    python -m tools.bench.runtimes --artifacts DIR --out out/bench/runtimes --peers-venv DIR

Shapes at full size: one 448² frame → 256 visual tokens; prefill of 1,100 tokens (ours: four frames' embeddings and 76
text tokens; the peers: 1,100 ids, without the gather); then 80 decoded tokens; the action expert over 256 visual and
1,180 semantic tokens. Ours runs the split step, the peers the whole action expert. A generation of ours is the
runner's, with guesses: each round writes another text of `peers/answers.json`, recorded in a drive. Each contender is a
process pinned to the same cores; in each round every contender runs once while the others idle. Memory is that of a new
process that opens its parts and computes each task once.

Writes samples.json, summary.md and the workers' logs. Exit code 0 when every bar that could be compared is reached, 1
when one is not, 2 for bad input.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from edge.artifacts.files import ArtifactError
from edge.artifacts.manifest import load_artifacts
from edge.core.cli import EXIT_BAD_INPUT, EXIT_CHECK_FAILED, EXIT_DONE, command_line, write_result, write_whole
from firmware_bridge.system.terminal import CommandParser
from tools.bench.peers.contenders import (
    EVERYTHING,
    OURS,
    OWN_STACK,
    Contender,
    Verdict,
    chosen,
    judge_all,
    markdown,
    verdict_text,
)
from tools.bench.peers.rounds import ROOT, MemoryWatch, Peak, Round, Worker, WorkerError, run_rounds, worker_command
from tools.bench.peers.workload import Workload

INSTALL = "tools/bench/peers/install.sh"


class Bench:
    """One benchmark: contenders, their environments and results."""

    def __init__(self, args: argparse.Namespace, model: str, contenders: Sequence[Contender]) -> None:
        self.args, self.model, self.contenders = args, model, list(contenders)
        self.cores = frozenset(sorted(os.sched_getaffinity(0))[: args.threads])
        self.failures: dict[str, str] = {}
        self.versions: dict[str, dict[str, str]] = {}
        self.memory: dict[str, Peak] = {}
        self.rounds: list[Round] = []

    def failed(self, name: str, reason: str) -> None:
        """Remove a contender with the reason; the others continue."""
        self.failures[name] = reason
        sys.stderr.write(f"left out: {reason}\n")

    def prepare(self) -> None:
        """Build the peers' models. Raises WorkerError."""
        assets = sorted({asset for c in self.contenders for asset in c.assets})
        if not assets:
            return
        command = [str(self.args.peers_venv / "bin" / "python"), "-m", "tools.bench.peers.models.prepare"]
        command += ["--model", self.model, "--cache", str(self.args.cache.resolve()), *assets]
        log = self.args.out / "prepare.log"
        sys.stderr.write(f"preparing the peers' models (once; log: {log})\n")
        with log.open("wb") as stream:
            env = {**os.environ, "PYTHONPATH": str(ROOT)}
            code = subprocess.run(command, stdout=stream, stderr=stream, env=env, check=False).returncode
        if code:
            raise WorkerError(f"the peers' models cannot be made (code {code}); log: {log}")

    def worker(self, contender: Contender) -> Worker:
        """Create the contender's process without starting it."""
        venv_python = self.args.peers_venv / "bin" / "python"
        python = Path(sys.executable) if contender.stack == OURS else venv_python
        log = self.args.out / "logs" / (contender.name.replace(" ", "-").replace("/", "-") + ".log")
        log.parent.mkdir(exist_ok=True)
        return Worker(contender.name, worker_command(python, contender.stack), self.cores, log)

    def load(self, contender: Contender, worker: Worker) -> list[str]:
        """Open a worker's parts; returns its tasks. Raises WorkerError."""
        options = dict(contender.options)
        if contender.stack == OURS:
            options = {"artifacts": str(self.args.artifacts.resolve())}
        load = {"model": self.model, "cache": str(self.args.cache.resolve()), "threads": self.args.threads}
        answer = worker.ask({"load": {**load, "parts": contender.parts, "options": options}})
        self.versions[contender.name] = answer["versions"]
        return list(answer["tasks"])

    def measure_memory(self) -> None:
        """Measure the peak memory of every contender, each alone in a new process."""
        for contender in self.contenders:
            try:
                with self.worker(contender) as worker, MemoryWatch(worker.pid) as watch:
                    for task in self.load(contender, worker):
                        worker.ask({"run": task, "calls": 1})
                    self.memory[contender.name] = watch.peak()
            except WorkerError as error:
                self.failed(contender.name, str(error))
            else:
                sys.stderr.write(f"{contender.name}: peak {self.memory[contender.name].rss_mb:.0f} MB\n")

    def measure_time(self) -> None:
        """Run rounds of the control tasks, then of the language tasks; pairs never mix the two."""
        for group in ("control", "language"):
            field = [
                c
                for c in self.contenders
                if c.tasks and ("language" in c.parts) == (group == "language") and c.name not in self.failures
            ]
            with ExitStack() as stack:
                alive: dict[str, tuple[Worker, Sequence[str]]] = {}
                for contender in field:
                    try:
                        worker = stack.enter_context(self.worker(contender))
                        self.load(contender, worker)
                    except WorkerError as error:
                        self.failed(contender.name, str(error))
                    else:
                        alive[contender.name] = (worker, contender.tasks)
                for done in run_rounds(group, alive, self.args.repeats, self.args.quiet_wait_s, self.failed):
                    self.rounds.append(done)
                    state = "quiet" if done.quiet else "DISTURBED by other work"
                    sys.stderr.write(f"{group} round {done.index + 1}: {state}, load {done.load_average[0]:.2f}\n")

    def counted(self, group: str) -> list[Round]:
        """Return the quiet rounds of a group if there are enough, else all rounds."""
        rounds = [r for r in self.rounds if r.group == group]
        quiet = [r for r in rounds if r.quiet]
        return quiet if len(quiet) >= self.args.repeats else rounds

    def series(self) -> dict[str, dict[str, list[float]]]:
        """Return metric → contender → one value per counted round, without contenders that failed."""
        found: dict[str, dict[str, list[float]]] = {}
        for group in ("control", "language"):
            for sample in (s for r in self.counted(group) for s in r.samples if s.contender not in self.failures):
                for metric, value in sample.values.items():
                    found.setdefault(metric, {}).setdefault(sample.contender, []).append(value)
        for c in self.contenders:
            parts = {("language",): "language", EVERYTHING: "everything"}.get(c.parts)
            if parts and c.name in self.memory and c.name not in self.failures:
                for kind in ("rss", "anon"):
                    value = float(getattr(self.memory[c.name], f"{kind}_mb"))
                    found.setdefault(f"{parts}_{kind}_mb", {})[c.name] = [value]
        return found

    def disturbed(self) -> int:
        """Return the number of counted rounds in which other work ran."""
        return sum(not r.quiet for group in ("control", "language") for r in self.counted(group))

    def result(self, verdicts: Sequence[Verdict]) -> dict[str, Any]:
        """Return the content of the JSON file."""
        return {
            "tagged": "measured",
            "machine": machine(),
            "model": self.model,
            "artifacts": str(self.args.artifacts) if self.args.artifacts else None,
            "threads": self.args.threads,
            "cores": sorted(self.cores),
            "contenders": [
                asdict(c)
                | {
                    "versions": self.versions.get(c.name),
                    "memory_peak": asdict(self.memory[c.name]) if c.name in self.memory else None,
                    "left_out": self.failures.get(c.name),
                }
                for c in self.contenders
            ],
            "rounds": [r.to_dict() for r in self.rounds],
            "verdicts": [asdict(v) for v in verdicts],
        }


def machine() -> dict[str, Any]:
    """Return the processor's name, relevant instruction sets, number of cores and memory."""
    wanted = {"avx2", "avx512f", "avx512_vnni", "avx512_bf16", "avx_vnni", "amx_int8", "amx_bf16", "asimddp", "i8mm"}
    info = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    fields = {line.partition(":")[0].strip(): line.partition(":")[2].strip() for line in info if ":" in line}
    flags = set(fields.get("flags", fields.get("Features", "")).split())
    return {
        "cpu": fields.get("model name", platform.machine()),
        "family_model": f"{fields.get('cpu family', '?')}/{fields.get('model', '?')}",
        "flags": sorted(flags & wanted),
        "cores": os.cpu_count(),
        "memory_mb": round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e6),
        "kernel": platform.release(),
        "python": platform.python_version(),
    }


def notes(bench: Bench) -> list[str]:
    """Return the notes of the summary."""
    found = machine()
    counted = {group: len(bench.counted(group)) for group in ("control", "language")}
    return [
        f"{found['cpu']} ({', '.join(found['flags'])}), {bench.args.threads} thread(s), model {bench.model}",
        f"medians over {counted['control']} rounds (encoder, action expert) and {counted['language']} (language "
        f"model), {bench.disturbed()} of them disturbed by other work; raw samples in samples.json",
        "the peers' prompt is ids, ours is image embeddings and ids; the peers run the action expert whole, ours split",
        "the memory bar uses peak RSS, which counts mapped weight files; without them: the rows after it",
        *(f"left out: {reason}" for reason in bench.failures.values()),
    ]


def show(verdicts: Sequence[Verdict]) -> None:
    """Print the table."""
    table = Table(title="medians, best first")
    for column in ("quantity", "contender", "median", "min – max", "ours against the best peer"):
        table.add_column(column, justify="right" if column in ("median", "min – max") else "left")
    for v in verdicts:
        for i, row in enumerate(v.rows):
            name = f"[bold]{row.contender}[/]" if row.ours else row.contender
            span = f"{row.low:.4g} – {row.high:.4g}"
            head, tail = (v.metric.title, verdict_text(v)) if i == 0 else ("", "")
            table.add_row(head, name, f"{row.median:.4g} {v.metric.unit}", span, tail)
        table.add_section()
    console = Console()
    # Into a file or a pipe, rich would fold the table to 80 columns.
    (console if console.is_terminal else Console(width=150)).print(table)


def arguments(argv: list[str] | None) -> argparse.Namespace:
    """Parse the command line."""
    p = CommandParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument(
        "--artifacts", type=Path, metavar="DIR", help="artifacts to compare; without it only the peers are measured"
    )
    p.add_argument("--model", help="the peers' network without --artifacts (default: 1b)")
    p.add_argument("--out", type=Path, required=True, metavar="DIR")
    p.add_argument("--peers-venv", type=Path, default=Path("out/peers-venv"), metavar="DIR", help=f"made by {INSTALL}")
    p.add_argument("--cache", type=Path, default=Path("out/bench-peers"), metavar="DIR", help="the peers' models")
    p.add_argument("--repeats", type=int, default=7, help="quiet rounds (default: 7)")
    p.add_argument("--threads", type=int, default=2)
    p.add_argument("--quiet-wait-s", type=float, default=60.0, help="longest wait for other work to end")
    p.add_argument("--only", nargs="+", default=[], metavar="NAME", help="contenders by name, * matches anything")
    return p.parse_args(argv)


def checked(args: argparse.Namespace) -> Bench:
    """Create the benchmark of the command line. Raises ValueError or OSError with a one-line message."""
    cores = len(os.sched_getaffinity(0))
    if args.repeats < 1 or not 1 <= args.threads <= cores:
        raise ValueError(f"--repeats must be positive and --threads 1 to {cores}")
    contenders = [c for c in chosen(args.only) if args.artifacts or c.stack != OURS]
    model = load_artifacts(args.artifacts).model_name if args.artifacts else args.model or "1b"
    if args.model not in (None, model):
        raise ValueError(f"--model {args.model}: {args.artifacts} holds {model}")
    Workload(model)
    if any(c.stack != OURS for c in contenders) and not (args.peers_venv / "bin" / "python").exists():
        raise ValueError(f"{args.peers_venv}: no environment of the peers; make it with: {INSTALL} {args.peers_venv}")
    args.out.mkdir(parents=True, exist_ok=True)
    return Bench(args, model, contenders)


@command_line("runtimes")
def main(argv: list[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    args = arguments(argv)
    try:
        bench = checked(args)
        bench.prepare()
    except (ArtifactError, ValueError, OSError, WorkerError) as error:
        sys.stderr.write(f"{error}\n")
        return EXIT_BAD_INPUT
    bench.measure_memory()
    bench.measure_time()
    verdicts = judge_all(bench.series(), {c.name: c.stack for c in bench.contenders})
    write_result(str(args.out / "samples.json"), json.loads(json.dumps(bench.result(verdicts))))
    write_whole(args.out / "summary.md", markdown(verdicts, "Runtimes compared", notes(bench)))
    show(verdicts)
    print(f"{args.out / 'summary.md'} and samples.json written")
    reached = [v.reached for v in verdicts]
    if all(c.stack in OWN_STACK for c in bench.contenders):
        return EXIT_DONE  # measured alone as requested: no peer to compare with
    return EXIT_DONE if True in reached and False not in reached else EXIT_CHECK_FAILED


if __name__ == "__main__":
    sys.exit(main())
