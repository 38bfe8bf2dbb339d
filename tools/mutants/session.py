"""Runs one module's tests against its mutants: each in a forked process, only the tests that execute the line."""

from __future__ import annotations

import importlib
import os
import signal
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import coverage
import pytest

from tools.mutants.graft import BrokenModuleError, graft
from tools.mutants.operators import Mutant, mutants_of

KILLED, SURVIVED, TIMEOUT, UNREACHED = "killed", "survived", "timeout", "unreached"
FAILED: Final = "this tool failed"
_RESULTS: Final = {0: SURVIVED, 1: KILLED, 2: FAILED}
"""Exit code of the process of a mutant; one that is killed by a signal has crashed in the test."""
_LEAST_S: Final = 10.0
"""Time limit of one test of a mutant, above ten times what it needs without a change."""
_POLL_S: Final = 0.002


@dataclass
class _Timed:
    """A collected test, the time that it takes without a change, and the lines of the module that it executes."""

    item: pytest.Item
    took_s: float
    lines: frozenset[int]


@dataclass
class MutantSession:
    """Plugin of pytest that replaces its run. `known`: keys that need no run. `report`: takes key and result.

    `problem`: why there are no results; empty when there are.
    """

    module: str
    known: Mapping[str, str]
    deadline_ns: int
    report: Callable[[str, str], None]
    problem: str = ""
    unfinished: int = 0
    _failed: list[str] = field(default_factory=list)

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        """Run all tests once without a change, then some of them for each mutant."""
        target = importlib.import_module(self.module)
        path = Path(str(target.__file__))
        tests = self._without_change(session, path)
        if self._failed or not tests:
            self.problem = f"without a change these tests fail: {', '.join(self._failed[:3])}" if tests else "no tests"
            return True
        reached = frozenset[int]().union(*(test.lines for test in tests))
        for mutant in mutants_of(path.read_text(encoding="utf-8")):
            if mutant.key in self.known:
                continue
            if time.monotonic_ns() > self.deadline_ns:
                self.unfinished += 1
                continue
            chosen = [test for test in tests if mutant.line in test.lines]
            if mutant.line not in reached:  # run at the import: constants, and defaults of arguments
                inside = range(mutant.span[0], mutant.span[1] + 1) if _in_function(target, mutant) else None
                chosen = [test for test in tests if inside is None or not test.lines.isdisjoint(inside)]
            if not chosen:
                self.report(mutant.key, UNREACHED)
                continue
            chosen.sort(key=lambda test: test.took_s)
            self.report(mutant.key, self._run(session, target, mutant, chosen))
        return True

    def _without_change(self, session: pytest.Session, path: Path) -> list[_Timed]:
        measured = coverage.Coverage(data_file=None, include=[str(path)], messages=False)
        tests, times = [], []
        measured.start()
        for item in session.items:
            measured.switch_context(item.nodeid)
            started_ns = time.monotonic_ns()
            item.config.hook.pytest_runtest_protocol(item=item, nextitem=session)
            times.append((time.monotonic_ns() - started_ns) / 1e9)
        measured.stop()
        data = measured.get_data()
        for item, took_s in zip(session.items, times, strict=True):
            data.set_query_context(item.nodeid)
            tests.append(_Timed(item, took_s, frozenset(data.lines(str(path)) or ())))
        return tests

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Note tests that fail."""
        if report.failed:
            self._failed.append(report.nodeid)

    def _run(self, session: pytest.Session, target: object, mutant: Mutant, tests: list[_Timed]) -> str:
        sys.stdout.flush()
        sys.stderr.flush()
        reading, writing = os.pipe()
        child = os.fork()
        if child == 0:
            self._try(session, target, mutant, tests, writing)
        os.close(writing)
        os.set_blocking(reading, False)
        ended, waiting = 0, iter(tests)
        end_ns = time.monotonic_ns() + round(_LEAST_S * 1e9)
        try:
            while True:
                ended, status = os.waitpid(child, os.WNOHANG)
                if ended:
                    return _RESULTS.get(os.waitstatus_to_exitcode(status), KILLED)
                now_ns = time.monotonic_ns()
                if _has_begun(reading):
                    end_ns = now_ns + round((_LEAST_S + 10 * next(waiting).took_s) * 1e9)
                elif now_ns > end_ns:
                    return TIMEOUT
                time.sleep(_POLL_S)
        finally:
            os.close(reading)
            if not ended:
                os.kill(child, signal.SIGKILL)
                os.waitpid(child, 0)

    def _try(self, session: pytest.Session, target: object, mutant: Mutant, tests: list[_Timed], writing: int) -> None:
        """In the child: ends it with 0 when every test passes; says through a pipe that a test begins."""
        os.setsid()
        code = 2
        try:
            quiet = os.open(os.devnull, os.O_WRONLY)
            os.dup2(quiet, 1)
            os.dup2(quiet, 2)
            graft(sys.modules[self.module], mutant)
            code = 0
            for test in tests:
                os.write(writing, b".")
                test.item.config.hook.pytest_runtest_protocol(item=test.item, nextitem=session)
                if self._failed:
                    code = 1
                    break
        except BrokenModuleError:
            code = 1
        finally:
            os._exit(code)


def _has_begun(reading: int) -> bool:
    """Whether the child has begun one more test."""
    try:
        return os.read(reading, 1) == b"."
    except BlockingIOError:
        return False


def _in_function(target: object, mutant: Mutant) -> bool:
    """Whether the change is in a function, not in a constant or in a class's values."""
    member = target
    for name in mutant.place:
        member = vars(member).get(name)
    return bool(mutant.place) and not isinstance(member, type)
