"""`edge-hil` as a peer on the bus: the camera's process, the whole command, and how both end."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import psutil
import pytest

from firmware_bridge.core.config import DdsConfig, load_robot_config
from firmware_bridge.dds.bus import Bus
from firmware_bridge.unitree.client import Go2Reader
from firmware_bridge.unitree.messages import ids
from firmware_bridge.unitree.rpc import RpcClient, RpcError, move_parameter
from sim_hil.hil.command import main
from sim_hil.protocols.render_process import CameraProcessError, RenderProcess
from tests.support.processes import (
    GO2_SIM,
    REPOSITORY,
    Running,
    claimed_dds_domain,
    hil_arguments,
    read_trace,
    running,
    wait_for,
)
from tests.support.robot.front_end_contract import options

pytestmark = pytest.mark.process


class TestRenderProcess:
    @pytest.fixture
    def started(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., RenderProcess]:
        """Starts a camera process that writes one line and then waits for the end of its input."""

        def start(line: str, then: str = "exec cat") -> RenderProcess:
            script = tmp_path / "camera"
            script.write_text(f"#!/bin/sh\nprintf '%b' '{line}'\n{then}\n")
            script.chmod(0o700)
            monkeypatch.setattr(sys, "executable", str(script))
            return RenderProcess("camera", options("go2", camera_size=(64, 48)), [], 19)

        return start

    def test_a_stop_request_ends_the_wait_for_it(self, started: Callable[..., RenderProcess]) -> None:
        camera = started("")
        assert camera.wait_ready([signal.SIGINT]) is False
        camera.close()

    @pytest.mark.slow
    def test_a_process_that_closes_its_output_and_lives_on_is_not_waited_for(
        self, started: Callable[..., RenderProcess]
    ) -> None:
        camera = started("", then="exec cat >/dev/null")
        with pytest.raises(CameraProcessError, match="still runs"):
            camera.wait_ready([])
        camera.close()

    @pytest.mark.parametrize("line", ["hello", "[1]", '{"event": 1}', "{}", r"\0377", "[" * 4000])
    def test_a_line_that_is_no_event_is_named(self, started: Callable[..., RenderProcess], line: str) -> None:
        camera = started(line + r"\n")
        with pytest.raises(CameraProcessError, match="expected an event"):
            camera.wait_ready([])
        camera.close()


@pytest.fixture(scope="module")
def hil(dds_domain: int, tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Running, Path]]:
    folder = tmp_path_factory.mktemp("hil")
    more = ("--people", 2, "--seed", 3, "--trace", folder / "t.jsonl", "--json", folder / "r.json")
    with running("sim_hil.hil.command", *hil_arguments(dds_domain, *more), folder=folder) as started:
        yield started, folder


@pytest.fixture(scope="module")
def bus(dds_domain: int) -> Iterator[Bus]:
    bus = Bus(DdsConfig(dds_domain, "lo", ("127.0.0.1",)))
    yield bus
    bus.close()


@pytest.fixture(scope="module")
def reader(bus: Bus, hil: tuple[Running, Path]) -> Iterator[Go2Reader]:
    reader = Go2Reader(load_robot_config(GO2_SIM), bus=bus)
    wait_for(lambda: reader.state() is not None, 20, "the robot's state")
    yield reader
    reader.close()


class TestRealProcess:
    """In this order, and all in one tier: one edge-hil is used up from the robot's start to its end."""

    def test_it_starts_lying_down_at_the_odometry_origin(self, reader: Go2Reader) -> None:
        state = reader.state()
        assert state is not None and state.mode == ids.MODE_LIE_DOWN
        assert state.T_odom_base == pytest.approx((0, 0, 0), abs=0.05)

    def test_balance_stand_is_refused_while_it_lies(self, bus: Bus, reader: Go2Reader) -> None:
        with pytest.raises(RpcError) as error:
            RpcClient(bus, ids.SPORT_SERVICE).call(ids.BALANCE_STAND, timeout_s=20)
        assert error.value.code == 4202

    def test_an_unknown_api_and_a_bad_move_get_their_codes(self, bus: Bus, reader: Go2Reader) -> None:
        client = RpcClient(bus, ids.SPORT_SERVICE)
        for api_id, code in ((1030, 3203), (ids.MOVE, 3204)):
            with pytest.raises(RpcError) as error:
                client.call(api_id, "{}", timeout_s=20)
            assert error.value.code == code

    def test_it_stands_up_and_walks_as_commanded(self, bus: Bus, reader: Go2Reader) -> None:
        client = RpcClient(bus, ids.SPORT_SERVICE)
        client.call(ids.STAND_UP, timeout_s=20)
        wait_for(lambda: reader.state().mode == ids.MODE_JOINT_LOCK, 20, "standing")
        client.call(ids.BALANCE_STAND, timeout_s=20)
        wait_for(lambda: reader.state().mode == ids.MODE_BALANCE_STAND, 20, "balanced")

        def has_walked() -> bool:
            client.send(ids.MOVE, move_parameter(0.5, 0.0, 0.0), noreply=True)
            return reader.state().T_odom_base[0] > 0.5

        wait_for(has_walked, 20, "the robot to walk 0.5 m")
        assert reader.state().mode == ids.MODE_LOCOMOTION
        client.call(ids.STOP_MOVE, timeout_s=20)
        wait_for(lambda: reader.state().mode == ids.MODE_BALANCE_STAND, 20, "standing again")

    def test_pictures_are_pictures_and_change_as_it_walks(self, bus: Bus, reader: Go2Reader) -> None:
        client = RpcClient(bus, ids.SPORT_SERVICE)
        theta_rad = reader.state().T_odom_base[2]

        def picture() -> np.ndarray:
            return cv2.imdecode(np.frombuffer(reader.request_frame(20.0), np.uint8), cv2.IMREAD_COLOR)

        def has_turned() -> bool:
            client.send(ids.MOVE, move_parameter(0.0, 0.0, 0.8), noreply=True)
            return reader.state().T_odom_base[2] - theta_rad > 0.4

        pictures = [picture()]
        wait_for(has_turned, 20, "the robot to turn")
        pictures.append(picture())
        assert pictures[0].shape == (180, 320, 3)
        assert float(np.abs(pictures[0].astype(int) - pictures[1]).mean()) > 5

    def test_the_trace_contains_the_requests_on_the_wire(self, hil: tuple[Running, Path]) -> None:
        def names() -> list[str]:
            return [line["name"] for line in read_trace(hil[1] / "t.jsonl") if line["kind"] == "wire"]

        wait_for(lambda: names().count("GetImageSample") == 2, 20, "the last request in the trace")
        lines = read_trace(hil[1] / "t.jsonl")
        assert lines[0]["kind"] == "scene" and lines[0]["name"] == "corridor" and lines[0]["footprints"]
        assert {"StandUp", "BalanceStand", "Move", "StopMove", "GetImageSample", "1030"} <= set(names())
        assert all(len(line["poses"]) == 2 for line in lines if line["kind"] == "people")

    def test_it_ends_cleanly_at_sigterm_with_its_result(self, hil: tuple[Running, Path], reader: Go2Reader) -> None:
        started, folder = hil
        assert started.end(timeout_s=20) == 0
        result = json.loads((folder / "r.json").read_text())
        assert (result["scene"], result["people"], result["seed"], result["fell"]) == ("corridor", 2, 3, False)
        assert result["path_m"] > 0.5 and result["video_frames"] == 2
        assert result["wire"]["malformed"] == 0
        assert result["state_hz"] == pytest.approx(50 * result["real_time_factor"], rel=0.05)
        trace = read_trace(folder / "t.jsonl")
        assert {key: trace[-1][key] for key in result} == result
        # 10 poses and 5 lines of people a second of simulated time, however fast the machine simulates it.
        simulated_s = result["duration_s"] * result["real_time_factor"]
        kinds = [line["kind"] for line in trace]
        assert kinds.count("pose") == pytest.approx(10 * simulated_s, abs=2)
        assert kinds.count("people") == pytest.approx(5 * simulated_s, abs=2)


def _camera_pid(hil_pid: int) -> int:
    (camera,) = psutil.Process(hil_pid).children()
    return camera.pid


def _alive(pid: int) -> bool:
    try:
        return psutil.Process(pid).status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False


@pytest.mark.slow
def test_a_dead_camera_process_ends_the_robot_with_an_error(dds_domain: int, tmp_path: Path) -> None:
    with running("sim_hil.hil.command", *hil_arguments(dds_domain), folder=tmp_path) as started:
        os.kill(_camera_pid(started.pid), signal.SIGKILL)
        assert started.process.wait(20) == 1
        assert "the camera process died" in started.stderr()


@pytest.mark.slow
def test_the_camera_process_does_not_outlive_its_parent(dds_domain: int, tmp_path: Path) -> None:
    with running("sim_hil.hil.command", *hil_arguments(dds_domain), folder=tmp_path) as started:
        camera = _camera_pid(started.pid)
        started.process.kill()
        started.process.wait()
        wait_for(lambda: not _alive(camera), 20, "the end of the camera process")


@pytest.fixture(scope="module")
def own_domain() -> Iterator[int]:
    """DDS domain for an `edge-hil` in this process, which can open a domain only once."""
    with claimed_dds_domain() as domain:
        yield domain


def exit_status(command: list[str]) -> int:
    """Exit status of `edge-hil`, run in this process: what fails before it is ready needs no process of its own."""
    try:
        return main(command)
    except SystemExit as ended:
        return int(ended.code or 0)


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["--scene", "moon"], "moon"),
        (["--scene", "nowhere/moon.toml"], "moon.toml"),
        (["--protocol", "can"], "protocol of this robot, unitree"),
        (["--robot", "carter"], "--robot carter --protocol unitree"),
        (["--start", "1,2"], "X,Y,DEG"),
        (["--start", "1000,0,0"], "--start"),
        (["--camera", "none", "--faults", "f.sock"], "--camera none"),
        (["--people", "100000"], "people"),
        (["--people", "-1"], "--people"),
        (["--seed", "-1"], "--seed"),
        (["--camera", "huge"], "expected WxH"),
        (["--interface", "nosuch0"], "nosuch0"),
        (["--duration", "0"], "--duration"),
        (["--gui"], "DISPLAY"),
        (["--trace", "/nowhere/t.jsonl"], "/nowhere/t.jsonl"),
        (["--json", "/dev/null/r.json"], "--json /dev/null/r.json"),
    ],
)
def test_bad_arguments_are_one_line_and_exit_status_2(
    own_domain: int,
    arguments: list[str],
    complaint: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    defaults = {"--robot": "go2", "--scene": "corridor", "--protocol": "unitree", "--domain": str(own_domain)}
    given_flags = set(arguments[::2])
    command = [word for flag, value in defaults.items() if flag not in given_flags for word in (flag, value)]
    monkeypatch.delenv("DISPLAY", raising=False)
    assert exit_status([*command, *arguments]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert complaint in lines[-1]
    assert not any(re.search(r"\bready\b", line) for line in lines)


@pytest.mark.parametrize("arguments", [("--people", 100000), ("--seed", -1), ("--interface", "nosuch0")])
def test_bad_arguments_leave_an_earlier_trace_alone(
    own_domain: int, tmp_path: Path, arguments: tuple[object, ...]
) -> None:
    trace = tmp_path / "t.jsonl"
    trace.write_text("precious\n")
    assert exit_status([str(word) for word in hil_arguments(own_domain, "--trace", trace, *arguments)]) == 2
    assert trace.read_text() == "precious\n"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("where", "failure"),
    [
        ("Simulation.step", "pybullet.disconnect(args[0].client)"),  # what closing the window does
        ("Simulation.render_state", 'raise pybullet.error("the window was closed")'),
        ("RenderProcess.wait_ready", 'raise CameraProcessError("the window was closed")'),
        ("ServiceServer.serve", 'raise ValueError("the window was closed")'),
    ],
)
def test_a_run_that_fails_is_one_line_a_result_an_end_line_and_exit_status_1(
    dds_domain: int, tmp_path: Path, where: str, failure: str
) -> None:
    code = f"""
import sys
import pybullet
from sim_hil.hil import command as hil
from sim_hil.simulation.physics import Simulation
from sim_hil.protocols.render_process import CameraProcessError, RenderProcess
from sim_hil.protocols.unitree.services.service import ServiceServer
calls = []
before = {where}
def fails(*args, **kwargs):
    calls.append(args)
    if len(calls) > 2 or "wait_ready" in "{where}":  # the first calls are construction's and the start's
        {failure}
    return before(*args, **kwargs)
{where} = fails
sys.exit(hil.main(sys.argv[1:]))
"""
    more = ("--trace", tmp_path / "t.jsonl", "--json", tmp_path / "r.json", "--duration", 20)
    command = [sys.executable, "-c", code, *map(str, hil_arguments(dds_domain, *more))]
    done = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, timeout=300)
    assert done.returncode == 1, done.stderr
    assert "the window was closed" in done.stderr.splitlines()[-1]
    assert "Traceback" not in done.stderr
    result = json.loads((tmp_path / "r.json").read_text())
    assert (result["robot"], result["scene"], result["wire"]["commands"]) == ("go2", "corridor", 0)
    lines = read_trace(tmp_path / "t.jsonl")
    assert [lines[0]["kind"], lines[-1]["kind"]] == ["scene", "end"]
    assert {key: lines[-1][key] for key in result} == result


@pytest.mark.slow
def test_a_signal_ends_it_while_the_camera_still_starts(dds_domain: int, tmp_path: Path) -> None:
    arguments = map(str, hil_arguments(dds_domain, "--json", tmp_path / "r.json"))
    with subprocess.Popen(
        [sys.executable, "-m", "sim_hil.hil.command", *arguments], cwd=REPOSITORY, stderr=subprocess.PIPE, text=True
    ) as process:
        try:
            hil = psutil.Process(process.pid)
            wait_for(lambda: hil.children(), 40, "the camera process to be started")
            hil.children()[0].suspend()  # a camera that never gets ready
            time.sleep(0.2)
            process.terminate()
            _, error = process.communicate(timeout=20)
        finally:
            process.kill()
    assert process.returncode == 0, error
    assert "ready" not in error
    assert json.loads((tmp_path / "r.json").read_text())["duration_s"] == 0.0
