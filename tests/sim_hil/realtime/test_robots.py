"""Robots of the real-time tools: every run's own robot file, and what edge-hil is started with."""

from __future__ import annotations

import socket
from dataclasses import replace
from pathlib import Path

import pytest

from firmware_bridge.core.config import load_robot_config
from sim_hil.protocols.registry import check_combination, check_flags
from sim_hil.realtime.robots import GO2, ROBOTS, RunAddress, StackRobot, StackRobotError, free_port, robot_of

each_robot = pytest.mark.parametrize("robot", ROBOTS.values(), ids=lambda robot: robot.name)


@pytest.fixture
def address(tmp_path: Path) -> RunAddress:
    return RunAddress(Path("/tmp/tic-run"), 77, 14_999, 8_099)


@each_robot
def test_a_runs_file_is_the_shipped_one_but_for_its_addresses(
    robot: StackRobot, address: RunAddress, tmp_path: Path
) -> None:
    config, shipped = (
        load_robot_config(path) for path in (robot.write_file(tmp_path / "robot.toml", address), robot.file)
    )
    assert config.protocol == shipped.protocol == robot.protocol
    assert config.bridge.socket == Path("/tmp/tic-run/bridge")
    assert replace(config.bridge, socket=shipped.bridge.socket) == shipped.bridge
    assert config.limits == shipped.limits and config.safety == shipped.safety and config.mount == shipped.mount


@each_robot
def test_two_runs_share_no_address(robot: StackRobot, tmp_path: Path) -> None:
    files = []
    for name in ("a", "b"):
        folder = tmp_path / name
        folder.mkdir()
        address = RunAddress.free(folder, domain=len(files) + 1)
        config = load_robot_config(robot.write_file(folder / "robot.toml", address))
        files.append({config.address, str(config.bridge.socket), *robot.hil_arguments(address)})
    shared = files[0] & files[1]
    assert shared <= {"--robot", "--protocol", "--interface", "lo", robot.hil_robot, robot.protocol}


@each_robot
def test_a_slow_robot_differs_in_its_speed_limit_alone(robot: StackRobot, address: RunAddress, tmp_path: Path) -> None:
    slow, standard = (
        load_robot_config(robot.write_file(tmp_path / f"{limit}.toml", address, limit)) for limit in (0.1, None)
    )
    assert slow.limits.vx_max_mps == 0.1 and standard.limits.vx_max_mps > 0.1
    assert replace(slow, limits=standard.limits) == standard


@each_robot
def test_edge_hil_knows_the_robot_and_its_arguments(robot: StackRobot, address: RunAddress) -> None:
    check_combination(robot.hil_robot, robot.protocol)
    flags = [each.partition("=")[0] for each in robot.hil_arguments(address)]
    check_flags(robot.protocol, [flag for flag in flags if flag in ("--domain", "--interface", "--link")])


def test_a_robot_without_a_file_is_refused_in_one_line(address: RunAddress, tmp_path: Path) -> None:
    with pytest.raises(StackRobotError, match=r"--robot go2: .*nowhere\.toml: cannot be read"):
        replace(GO2, shipped="nowhere.toml").write_file(tmp_path / "robot.toml", address)


def test_an_unknown_robot_is_refused_with_the_known_ones() -> None:
    with pytest.raises(StackRobotError, match=r"expected one of go2, carter-can.*found 'spot'"):
        robot_of("spot")


@pytest.mark.parametrize("kind", [socket.SOCK_DGRAM, socket.SOCK_STREAM])
def test_a_free_port_can_be_bound(kind: socket.SocketKind) -> None:
    with socket.socket(socket.AF_INET, kind) as taken:
        taken.bind(("127.0.0.1", free_port(kind)))
