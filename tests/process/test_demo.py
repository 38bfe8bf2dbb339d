"""The demo's orchestration with stand-in commands: order, clear failures, and no process left behind."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import psutil
import pytest

from sim_hil.processes.child_process import last_lines
from sim_hil.realtime.children import Children, StepError
from sim_hil.realtime.robots import free_domain
from sim_hil.realtime.stack import socket_dir
from tools import demo
from tools.report.machine import machine_facts

REPOSITORY = Path(__file__).resolve().parents[2]
FAKE = REPOSITORY / "tests/support/runner/fake_step.py"
ROLES = {"edge-export": "export", "edge-hil": "hil", "edge-bridge": "bridge", "edge-run": "run"}


def fakes(**moods: str) -> dict[str, list[str]]:
    """Command table of stand-ins; e.g. fakes(hil="deaf")."""
    return {name: [sys.executable, str(FAKE), role, moods.get(role, "ok")] for name, role in ROLES.items()}


def left_behind(out: Path) -> list[str]:
    """Command lines of processes that still work for this output folder."""
    found = []
    for process in psutil.process_iter(["cmdline"]):
        line = " ".join(process.info["cmdline"] or [])
        if str(out) in line and str(FAKE) in line:
            found.append(line)
    return found


@pytest.fixture
def temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where the demo makes its temporary folder during the test."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    return tmp_path


def socket_folders(folder: Path) -> list[Path]:
    return list(folder.glob("tic-*"))


def run(out: Path, **moods: str) -> int:
    return demo.main(["--out", str(out), "--duration", "6", "--domain", "77"], commands=fakes(**moods))


@pytest.mark.slow
def test_all_steps_give_a_report_whose_path_is_the_last_line(
    tmp_path: Path, temporary: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run(tmp_path / "demo")
    out = capsys.readouterr().out
    assert out.splitlines()[-1] == str(tmp_path / "demo" / "report.html")
    assert (tmp_path / "demo" / "report.html").exists()
    assert json.loads((tmp_path / "demo" / "demo.json").read_text())["wall_s"] > 0
    assert left_behind(tmp_path) == [] and socket_folders(temporary) == []


def test_good_artifacts_are_not_exported_again(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "artifacts").mkdir()
    (tmp_path / "artifacts" / "manifest.json").write_text('{"model": {"trained": true}}')
    run(tmp_path, hil="fails")
    assert "verified, not exported again" in capsys.readouterr().err
    assert not (tmp_path / "log" / "edge-export.log").exists()


@pytest.mark.parametrize("shipped", [None, Path("nano.safetensors")])
def test_untrained_artifacts_are_exported_again_once_trained_weights_ship(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, shipped: Path | None
) -> None:
    (tmp_path / "artifacts").mkdir()
    (tmp_path / "artifacts" / "manifest.json").write_text('{"model": {"trained": false}}')
    monkeypatch.setattr(demo, "shipped_weights", lambda config: shipped)
    run(tmp_path, hil="fails")
    assert (tmp_path / "log" / "edge-export.log").exists() is (shipped is not None)


@pytest.mark.parametrize("content", ["", "[]", '{"model": null}', '{"model": {"trained": false}}'])
def test_only_trained_weights_may_walk_at_full_speed(tmp_path: Path, content: str) -> None:
    assert not demo.trained(tmp_path)
    (tmp_path / "manifest.json").write_text(content)
    assert not demo.trained(tmp_path)
    (tmp_path / "manifest.json").write_text('{"model": {"trained": true}}')
    assert demo.trained(tmp_path)


def test_an_old_report_does_not_survive_a_failed_run(tmp_path: Path) -> None:
    (tmp_path / "report.html").write_text("old")
    (tmp_path / "demo.json").write_text("{}")
    assert run(tmp_path, hil="fails") == 1
    assert not (tmp_path / "report.html").exists() and not (tmp_path / "demo.json").exists()


@pytest.mark.slow
@pytest.mark.parametrize(("role", "step"), [(role, step) for step, role in ROLES.items()])
def test_a_failing_step_is_named_with_its_log_and_last_lines(
    tmp_path: Path, temporary: Path, role: str, step: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(tmp_path, **{role: "fails"}) == 1
    captured = capsys.readouterr()
    assert f"demo: step '{step}' failed: " in captured.err
    assert str(tmp_path / "log" / f"{step}.log") in captured.err
    assert "    the reason is here" in captured.err
    assert captured.out == ""
    assert left_behind(tmp_path) == [] and socket_folders(temporary) == []


@pytest.mark.slow
def test_a_run_that_a_fault_ended_is_named_and_still_gets_its_report(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(tmp_path, run="faulty") == 1
    captured = capsys.readouterr()
    assert "step 'edge-run' failed: a fault ended the run" in captured.err
    assert "check faults failed" in captured.err and "the bridge stopped the robot" in captured.err
    assert captured.out == f"{tmp_path / 'report.html'}\n"
    assert left_behind(tmp_path) == []


@pytest.mark.slow
@pytest.mark.parametrize(
    ("moods", "message"),
    [
        ({"hil": "early", "run": "slow"}, "step 'edge-hil' failed: ended too early with exit code 7"),
        ({"hil": "slow"}, "step 'edge-hil' failed: no ready line within 1 s"),
    ],
    ids=["ends early", "never ready"],
)
def test_a_robot_that_ends_early_or_is_never_ready_fails_the_demo(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    moods: dict[str, str],
    message: str,
) -> None:
    if "run" not in moods:
        monkeypatch.setattr(demo, "READY_TIMEOUT_S", 1.0)
    assert run(tmp_path, **moods) == 1
    assert message in capsys.readouterr().err
    assert left_behind(tmp_path) == []


def test_a_program_that_does_not_exist_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    commands = {**fakes(), "edge-export": ["/nowhere/edge-export"]}
    assert demo.main(["--out", str(tmp_path), "--domain", "77"], commands=commands) == 1
    assert "step 'edge-export' failed: /nowhere/edge-export cannot be started" in capsys.readouterr().err


RUN_WITH_FAKES = """
import signal, sys
from tests.process.test_demo import run, Path
signal.signal(signal.SIGINT, signal.SIG_IGN)  # as a shell does for a job in the background
sys.exit(run(Path(sys.argv[1]), run=sys.argv[2]))
"""


def start_demo(out: Path, runner_mood: str) -> subprocess.Popen[str]:
    """The demo in a process of its own, returned once its runner drives."""
    process = subprocess.Popen(
        [sys.executable, "-c", RUN_WITH_FAKES, str(out), runner_mood],
        cwd=REPOSITORY,
        env={**os.environ, "TMPDIR": str(out)},  # what a killed demo cannot remove goes with the test's folder
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    end_ns = time.monotonic_ns() + 20_000_000_000
    log = out / "log" / "edge-run.log"
    while not (log.exists() and "run started" in log.read_text()):
        assert process.poll() is None, process.communicate()
        assert time.monotonic_ns() < end_ns, "the demo did not start its runner"
        time.sleep(0.02)
    return process


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_ctrl_c_ends_every_process_and_exits_130(tmp_path: Path, number: int) -> None:
    process = start_demo(tmp_path, "slow")
    assert len(socket_folders(tmp_path)) == 1
    process.send_signal(number)
    out, err = process.communicate(timeout=20)
    assert process.returncode == 130
    assert "interrupted, all processes ended" in err and out == ""
    assert left_behind(tmp_path) == [] and socket_folders(tmp_path) == []


@pytest.mark.slow
def test_even_a_killed_demo_leaves_no_process_behind(tmp_path: Path) -> None:
    process = start_demo(tmp_path, "slow")
    process.kill()
    process.communicate()
    end_ns = time.monotonic_ns() + 5_000_000_000
    while left_behind(tmp_path) and time.monotonic_ns() < end_ns:
        time.sleep(0.05)
    assert left_behind(tmp_path) == []


def test_a_child_deaf_to_sigint_is_killed_with_all_it_started(tmp_path: Path) -> None:
    script = (
        "import signal, subprocess, sys, time\n"
        "signal.signal(signal.SIGINT, signal.SIG_IGN)\n"
        "child = subprocess.Popen([sys.executable, '-c', 'import time; time.sleep(60)'])\n"
        "print(child.pid, flush=True)\n"
        "time.sleep(60)\n"
    )
    with Children(tmp_path, grace_s=0.2) as running:
        child = running.start("deaf", [sys.executable, "-c", script])
        running.wait_until(child, lambda: bool(last_lines(child.log)), 10, "grandchild", lambda: None)
        grandchild = int(last_lines(child.log)[0])
        with pytest.raises(StepError, match=r"step 'deaf' failed: did not end within 0\.2 s of SIGINT and was killed"):
            running.stop(child)
    assert not child.running
    end_ns = time.monotonic_ns() + 5_000_000_000
    while psutil.pid_exists(grandchild) and time.monotonic_ns() < end_ns:
        if psutil.Process(grandchild).status() == psutil.STATUS_ZOMBIE:  # it has ended; its new parent reaps it
            break
        time.sleep(0.02)
    assert time.monotonic_ns() < end_ns


def test_a_process_stays_on_the_processors_that_it_is_given(tmp_path: Path) -> None:
    processor = max(os.sched_getaffinity(0))
    with Children(tmp_path) as running:
        script = "import os; print(os.sched_getaffinity(0))"
        child = running.start("bridge", [sys.executable, "-c", script], processors=(processor,))
        running.wait(child, 10, lambda: None)
    assert last_lines(child.log) == [str({processor})]


def test_processes_end_in_reverse_order_of_their_start(tmp_path: Path) -> None:
    script = (
        "import signal, sys, time\n"
        # A shell starts what it runs in the background with SIGINT ignored, and children inherit that.
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "try:\n"
        "    print('up', flush=True)\n"
        "    time.sleep(60)\n"
        "except KeyboardInterrupt:\n"
        "    print(time.monotonic_ns(), flush=True)\n"
    )
    with Children(tmp_path) as running:
        for name in ("robot", "bridge", "runner"):
            child = running.start(name, [sys.executable, "-c", script])
            running.wait_until(child, lambda log=child.log: bool(last_lines(log)), 10, "line", lambda: None)
    ends = [int(last_lines(tmp_path / f"{name}.log")[-1]) for name in ("runner", "bridge", "robot")]
    assert ends == sorted(ends)


def test_the_bridges_socket_has_a_short_path_and_its_folder_is_removed() -> None:
    with socket_dir() as folder:
        assert len(os.fsencode(folder / "bridge.sock")) < 100
    assert not folder.exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--duration", "1"], "--duration must be 5 to 86400 s, found 1"),
        (["--seed", "-1"], "--seed and --people must not be negative"),
        (["--domain", "233"], "--domain must be 0 to 232 (DDS), found 233"),
    ],
)
def test_bad_arguments_are_one_line_and_exit_2(
    tmp_path: Path, arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert demo.main(["--out", str(tmp_path), *arguments], commands=fakes()) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1


@pytest.mark.parametrize("out", ["file", "file/demo"])
def test_a_folder_that_cannot_be_made_is_one_line_and_exit_2(
    tmp_path: Path, out: str, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("")
    assert run(tmp_path / out) == 2
    error = capsys.readouterr().err
    assert f"--out: cannot make the folder {tmp_path / out / 'log'}" in error and error.count("\n") == 1


def test_settings_note_the_machine_and_where_the_artifacts_are(tmp_path: Path) -> None:
    out, elsewhere = tmp_path / "demo", tmp_path / "elsewhere"
    assert run(out, hil="fails") == 1
    settings = json.loads((out / "settings.json").read_text())
    assert settings["artifacts"] == "artifacts" and settings["machine"] == machine_facts()
    demo.main(["--out", str(out), "--artifacts", str(elsewhere), "--domain", "77"], commands=fakes(hil="fails"))
    assert json.loads((out / "settings.json").read_text())["artifacts"] == str(elsewhere)


@pytest.mark.parametrize("free", [42, None])
def test_only_a_free_domain_is_chosen(tmp_path: Path, free: int | None) -> None:
    taken = [domain for domain in range(1, 91) if domain != free]
    lines = [f"   1: 0100007F:{7400 + 250 * domain + 11:04X} 00000000:0000 07\n" for domain in taken]
    (tmp_path / "udp").write_text("  sl  local_address rem_address   st\n" + "".join(lines))
    if free is not None:
        assert free_domain([tmp_path / "udp", tmp_path / "absent"]) == free
        return
    with pytest.raises(ValueError, match="no free DDS domain"):
        free_domain([tmp_path / "udp"])


def test_the_trace_is_followed_while_it_is_written(tmp_path: Path) -> None:
    path = tmp_path / "trace.jsonl"
    followed = demo.TraceTail(path)
    followed.update()
    pose = '{"t_ns": %d, "kind": "pose", "x": %f, "y": 0.0}\n'
    path.write_text(pose % (1_000_000_000, 0.0) + '{"t_ns": 2, "kind": "wire", "velocity": [0, 0, 0]}\n{"t_ns": 3, "ki')
    followed.update()
    assert (followed.moves, followed.walked_m) == (1, 0.0)
    with path.open("a") as stream:
        stream.write(
            'nd": "wire", "velocity": null}\n{"t_ns": 4, "kind": "wire", "velocity": [0.5, 0, 0]}\n'
            + pose % (2_100_000_000, 0.5)
        )
    followed.update()
    assert (followed.moves, followed.walked_m) == (2, 0.5)
