"""Child processes that report in lines of JSON: reading never waits, and no child outlives its handle."""

from __future__ import annotations

import sys
import time
from collections import deque
from pathlib import Path

import pytest

from sim_hil.benchmark.workers import worker_pool
from sim_hil.benchmark.workers.worker_pool import WorkerEvent, WorkerJob, Workers
from sim_hil.processes.child_process import ChildProcess, parse_message

PATIENCE_S = 20.0

WORKER = """
import argparse, json, os, sys, time
parser = argparse.ArgumentParser()
parser.add_argument("--fd", type=int)
parser.add_argument("--parent", type=int)
args = parser.parse_args()
job = json.load(sys.stdin)
print("printed by a library", flush=True)
with os.fdopen(args.fd, "w") as lines:
    for number in range(job["lines"]):
        lines.write(json.dumps({"number": number}) + "\\n")
        lines.flush()
    if job.get("hangs"):
        time.sleep(600)
sys.exit(job.get("code", 0))
"""


def child(code: str, **options: object) -> ChildProcess:
    return ChildProcess([sys.executable, "-u", "-c", code], **options)  # type: ignore[arg-type]


def lines_of(process: ChildProcess) -> list[bytes]:
    """All lines until the child closes its pipe."""
    lines: list[bytes] = []
    deadline_s = time.monotonic() + PATIENCE_S
    while not process.at_end and time.monotonic() < deadline_s:
        lines += process.read()
        time.sleep(0.01)
    return lines


def open_descriptors() -> int:
    return len(list(Path("/proc/self/fd").iterdir()))


def test_reading_returns_at_once_when_there_is_nothing() -> None:
    process = child("import time; time.sleep(600)")
    try:
        started_s = time.monotonic()
        assert process.read() == []
        assert time.monotonic() - started_s < 0.5 and not process.at_end
    finally:
        process.kill()
        process.close(1.0)


def test_a_line_is_returned_once_it_is_whole() -> None:
    process = child("import sys, time; print('a', end=''); sys.stdout.flush(); time.sleep(0.2); print('b'); print('c')")
    try:
        assert lines_of(process) == [b"ab", b"c"]
    finally:
        process.close(PATIENCE_S)


def test_a_sent_line_reaches_the_childs_standard_input() -> None:
    process = child("import sys; print(sys.stdin.readline().upper(), end='')")
    try:
        assert process.send(b"hello")
        assert process.read_one(PATIENCE_S) == b"HELLO"
        assert process.read_one(PATIENCE_S) is None, "the end of its pipe"
    finally:
        process.close(PATIENCE_S)


def test_an_answer_that_does_not_come_is_a_timeout() -> None:
    process = child("import time; time.sleep(600)")
    try:
        with pytest.raises(TimeoutError, match=r"no answer within 0\.1 s"):
            process.read_one(0.1)
    finally:
        process.kill()
        process.close(1.0)


def test_sending_to_a_dead_child_raises_its_own_error() -> None:
    process = child("")
    assert process.wait(PATIENCE_S) == 0
    assert not process.send(b"hello")
    process.close(1.0)


def test_a_child_that_ignores_the_end_of_its_input_is_killed() -> None:
    process = child("import time; print('up'); time.sleep(600)")
    assert process.read_one(PATIENCE_S) == b"up"
    process.close(0.1)
    assert process.poll() == -9


def test_closing_twice_and_a_failed_start_leave_no_descriptor_open(tmp_path: Path) -> None:
    before = open_descriptors()
    process = child("")
    process.close(PATIENCE_S)
    process.close(PATIENCE_S)
    with pytest.raises(OSError, match="no-such-program"):
        ChildProcess([str(tmp_path / "no-such-program")], log=tmp_path / "log")
    assert open_descriptors() == before


@pytest.mark.parametrize("line", [b"", b"hello", b"[1]", b'{"torn": ', b"\xff", b"[" * 100_000])
def test_a_line_that_is_no_object_is_no_message(line: bytes) -> None:
    assert parse_message(line) is None


# The pool


@pytest.fixture
def command(tmp_path: Path) -> list[str]:
    script = tmp_path / "worker.py"
    script.write_text(WORKER)
    return [sys.executable, str(script)]


def job(tmp_path: Path, key: str, **content: object) -> WorkerJob:
    return WorkerJob(key, {"lines": 0, **content}, tmp_path / f"{key}.log")


def run_all(command: list[str], jobs: deque[WorkerJob]) -> list[WorkerEvent]:
    with Workers(command, 2) as workers:
        return [event for events in workers.run(jobs, lambda: False) for event in events]


def test_messages_come_in_order_and_the_end_comes_last(tmp_path: Path, command: list[str]) -> None:
    events = run_all(command, deque([job(tmp_path, "a", lines=3)]))
    assert [event.message for event in events] == [{"number": 0}, {"number": 1}, {"number": 2}, None]
    assert events[-1].failure == "" and not (tmp_path / "a.log").exists()


def test_a_worker_that_fails_is_named_with_its_last_line(tmp_path: Path, command: list[str]) -> None:
    events = run_all(command, deque([job(tmp_path, "a", code=3)]))
    assert [(event.message, event.failure) for event in events] == [
        (None, "ended with exit code 3: printed by a library")
    ]


def test_a_job_added_while_others_run_is_run_too(tmp_path: Path, command: list[str]) -> None:
    waiting, ended, added = deque([job(tmp_path, "a")]), [], []
    with Workers(command, 1) as workers:
        for events in workers.run(waiting, lambda: False):
            ended += [event.key for event in events if event.message is None]
            if len(ended) == 1 and len(added) == 0:
                added.append(job(tmp_path, "b"))
                waiting += added
    assert ended == ["a", "b"]


def test_a_stop_ends_the_processes_that_run(tmp_path: Path, command: list[str]) -> None:
    pids: list[int] = []

    def stopped() -> bool:
        return bool(pids)

    with pytest.raises(KeyboardInterrupt), Workers(command, 1) as workers:
        for _ in workers.run(deque([job(tmp_path, "a", hangs=True)]), stopped):
            pids += workers.pids().values()
    assert len(pids) == 1 and not Path(f"/proc/{pids[0]}").exists()


def test_a_worker_that_is_silent_for_too_long_is_killed(
    tmp_path: Path, command: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(worker_pool, "SILENT_S", 2.0)
    events = run_all(command, deque([job(tmp_path, "a", hangs=True)]))
    assert events[-1].failure.startswith("ended by SIGKILL")


def test_fewer_jobs_than_none_are_refused(command: list[str]) -> None:
    with pytest.raises(ValueError, match="found -1"):
        Workers(command, -1)
