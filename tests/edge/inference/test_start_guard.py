"""A start that does not end is ended: the call first, then the process."""

from __future__ import annotations

import subprocess
import sys
import threading
import time

import pytest

from edge.artifacts.files import ArtifactError
from edge.artifacts.manifest import Artifacts
from edge.core.cli import EXIT_REFUSED
from edge.inference import start_guard
from edge.inference.start_guard import SPARE_BYTES, Memory, StartGuard, memory_limit

LITTLE = Memory(own=lambda: 0, available=lambda: 0)


def test_a_stage_within_its_limits_leaves_the_interrupt_unset(artifacts: Artifacts) -> None:
    guard = StartGuard(artifacts, memory=LITTLE)
    with guard.stage("opening", 60.0):
        pass
    assert not guard.interrupt.is_set
    assert not [thread for thread in threading.enumerate() if thread.name == "start-guard"]


def test_an_error_of_the_stage_is_raised_as_it_is(artifacts: Artifacts) -> None:
    with pytest.raises(ArtifactError, match=r"^a graph$"), StartGuard(artifacts, memory=LITTLE).stage("opening", 60.0):
        raise ArtifactError("a graph")


def test_native_code_that_ignores_the_interrupt_ends_the_process(
    artifacts: Artifacts, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(start_guard, "GRACE_S", 0.05)
    ended, lines = threading.Event(), list[str]()

    def end(line: str) -> None:
        lines.append(line)
        ended.set()

    guard = StartGuard(artifacts, memory=LITTLE, end=end)
    with pytest.raises(ArtifactError), guard.stage("opening the graphs", 0.05):
        assert ended.wait(20)
    assert guard.interrupt.is_set
    assert lines == [
        f"{artifacts.directory}: opening the graphs: not done after its limit of 0.05 s; "
        "verify the artifacts (edge-export verify) or export again"
    ]


def test_the_end_of_the_process_is_one_line_and_the_exit_code_of_a_refusal() -> None:
    code = "from edge.inference.start_guard import end_process; import sys; sys.argv[0] = 'edge-run'; end_process('x')"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (EXIT_REFUSED, "", "edge-run: x\n")


def test_memory_is_limited_by_the_weights_and_by_what_the_machine_has_left(artifacts: Artifacts) -> None:
    weights = sum(map(len, artifacts.contents.values()))
    assert memory_limit(artifacts, 0) == 4 * weights + artifacts.cache_bytes + SPARE_BYTES
    assert memory_limit(artifacts, 1000) == 900


@pytest.mark.slow
def test_memory_that_grows_is_seen_before_the_block_ends(artifacts: Artifacts) -> None:
    own = start_guard.LINUX.own
    guard = StartGuard(artifacts, memory=Memory(own=own, available=lambda: 50_000_000), end=lambda _line: None)
    with pytest.raises(ArtifactError, match=r"took \d+ MiB of memory, its limit is 42 MiB"), guard.stage("opening", 60):
        held = bytearray(b"\1" * 200_000_000)
        time.sleep(1.0)
        assert len(held) > 0
