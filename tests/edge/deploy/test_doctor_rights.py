"""`edge-doctor` on what a user may do and read: priority, memory, devices, the socket's folder; and on ONNX Runtime."""

from __future__ import annotations

import grp
import os
import resource
import stat
from dataclasses import replace
from pathlib import Path
from typing import ClassVar

import pytest

from edge.artifacts.providers import device_nodes, group_of
from edge.core.device import CUDA, TENSORRT
from edge.deploy.doctor.check import Check, Level
from edge.deploy.doctor.rights import (
    UserRights,
    device_access,
    locked_memory,
    power_meter,
    real_time,
    socket_folder,
    temperatures,
    user_named,
)
from edge.deploy.doctor.runtime import JETSON_INDEX, onnx_runtime
from edge.inference.graph import CPU_PROVIDER
from edge.power.meters.meter import MeterError, PowerSample
from firmware_bridge.core.config import OPERATOR_SUFFIX, ConfigError
from tests.edge.deploy.test_doctor_machine import write

ME = UserRights("somebody", 1000, frozenset({1000}), other=False)


def test_real_time_that_is_refused_is_a_warning() -> None:
    assert real_time(50, ME, lambda _priority: None).level is Level.OK
    assert real_time(50, ME, lambda _priority: "refused").level is Level.WARN
    assert real_time(0, ME, lambda _priority: "refused").level is Level.SKIP


def test_memory_may_be_locked_without_a_limit_or_by_root() -> None:
    assert locked_memory(resource.RLIM_INFINITY, ME).level is Level.OK
    assert locked_memory(65536, replace(ME, uid=0)).level is Level.OK
    assert locked_memory(65536, ME).level is Level.WARN


def test_device_nodes_must_be_there_and_open(tmp_path: Path) -> None:
    other = replace(ME, uid=4242, other=True)
    assert device_access([CPU_PROVIDER], tmp_path, other).level is Level.OK
    assert device_access([CUDA], tmp_path, other).level is Level.FAIL
    node = write(tmp_path, {"dev/nvmap": ""}) / "dev/nvmap"
    node.chmod(0o666)
    assert device_access([CUDA], tmp_path, other).level is Level.OK
    node.chmod(0o600)
    closed = device_access([CUDA], tmp_path, other)
    assert (closed.level, "usermod" in closed.advice, other.name in closed.found) == (Level.FAIL, True, True)


def chgrp_to_a_group_of_no_power(node: Path) -> None:
    """Root's own group never counts as a device's group; tests may run as root."""
    if os.geteuid() == 0:
        os.chown(node, -1, max(entry.gr_gid for entry in grp.getgrall()))


@pytest.mark.parametrize("mode", [0o440, 0o660], ids=["read-only, as on the Orin of NVIDIA/NemoClaw #4231", "writable"])
def test_a_device_is_open_to_its_group_and_only_warns_for_the_services_user(tmp_path: Path, mode: int) -> None:
    node = write(tmp_path, {"dev/nvmap": ""}) / "dev/nvmap"
    node.chmod(mode)
    chgrp_to_a_group_of_no_power(node)
    service = UserRights("service", 4242, frozenset({4242}), other=True)
    assert device_access([CUDA], tmp_path, service).level is Level.WARN
    member = replace(service, groups=frozenset({node.stat().st_gid}))
    assert device_access([CUDA], tmp_path, member).level is Level.OK


def test_another_users_right_to_a_file_is_that_of_its_class(tmp_path: Path) -> None:
    file = write(tmp_path, {"x": ""}) / "x"
    status = file.stat()
    owner = UserRights("owner", status.st_uid or 4242, frozenset(), other=True)
    stranger = UserRights("stranger", status.st_uid + 1, frozenset({status.st_gid + 1}), other=True)
    member = replace(stranger, groups=frozenset({status.st_gid}))
    file.chmod(0o604)
    assert [stranger.may(file), member.may(file), stranger.may(file, write=True)] == [True, False, False]
    file.chmod(0o060)
    assert [stranger.may(file), member.may(file, write=True)] == [False, True]
    assert replace(owner, uid=0).may(file, write=True)
    assert not stranger.may(tmp_path / "none")


def test_a_check_that_needs_another_users_rights_is_skipped_and_names_the_user() -> None:
    service = replace(ME, name="service", other=True)
    for check in (real_time(50, service, lambda _priority: None), locked_memory(65536, service)):
        assert (check.level, "service" in check.found) == (Level.SKIP, True)


def test_an_unknown_user_is_bad_input() -> None:
    with pytest.raises(ConfigError, match="--user no-such-user"):
        user_named("no-such-user")
    assert user_named(None).uid == os.geteuid()


@pytest.mark.parametrize(
    ("mode", "owner", "level"), [(0o700, 0, Level.OK), (0o755, 0, Level.FAIL), (0o700, 1, Level.FAIL)]
)
def test_no_other_user_may_reach_the_socket(tmp_path: Path, mode: int, owner: int, level: Level) -> None:
    tmp_path.chmod(mode)
    assert socket_folder(tmp_path / "bridge.sock", replace(ME, uid=tmp_path.stat().st_uid + owner)).level is level


class TestServiceSockets:
    """Sockets of the installed service: the bridge's user owns them, the runner is in the command socket's group."""

    RUNNERS, OPERATORS = 4301, 4302

    @pytest.fixture
    def path(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
        """Two socket files; `status` below says which groups they have, since only root can change that."""
        folder = tmp_path / "run"
        folder.mkdir()
        folder.chmod(0o711)
        path = folder / "bridge.sock"
        for file, group in ((path, self.RUNNERS), (Path(f"{path}{OPERATOR_SUFFIX}"), self.OPERATORS)):
            file.touch()
            file.chmod(0o660)
            monkeypatch.setitem(self.groups, file, group)
        real = Path.stat

        def status(file: Path, **options: bool) -> os.stat_result:
            found = list(real(file, **options))
            found[5] = self.groups.get(file, found[5])
            return os.stat_result(found)

        monkeypatch.setattr(Path, "stat", status)
        return path

    groups: ClassVar[dict[Path, int]] = {}

    def runner(self, path: Path, *groups: int) -> UserRights:
        return UserRights("runner", path.parent.stat().st_uid + 4000, frozenset(groups), other=True)

    def test_the_runner_reaches_its_own_socket_only(self, path: Path) -> None:
        assert socket_folder(path, self.runner(path, self.RUNNERS)).level is Level.OK

    def test_a_runner_in_the_operators_group_fails(self, path: Path) -> None:
        check = socket_folder(path, self.runner(path, self.RUNNERS, self.OPERATORS))
        assert (check.level, "take back an emergency stop" in check.advice) == (Level.FAIL, True)

    def test_a_runner_that_does_not_reach_its_socket_fails(self, path: Path) -> None:
        check = socket_folder(path, self.runner(path))
        assert (check.level, "--user" in check.advice) == (Level.FAIL, True)

    def test_a_runner_of_the_bridges_own_user_fails(self, path: Path) -> None:
        same = replace(self.runner(path, self.RUNNERS), uid=path.parent.stat().st_uid)
        if same.uid != 0:
            assert socket_folder(path, same).level is Level.FAIL

    @pytest.mark.parametrize("mode", [0o666, 0o662, 0o661])
    def test_a_world_reachable_socket_fails(self, path: Path, mode: int) -> None:
        for file in (path, Path(f"{path}{OPERATOR_SUFFIX}")):
            file.chmod(mode)
            assert socket_folder(path, self.runner(path, self.RUNNERS)).level is Level.FAIL
            file.chmod(0o660)

    def test_root_is_judged_by_modes_alone(self, path: Path) -> None:
        assert socket_folder(path, replace(self.runner(path), uid=0)).level is Level.OK

    def test_without_a_running_bridge_nothing_can_be_judged(self, path: Path) -> None:
        path.unlink()
        assert socket_folder(path, self.runner(path, self.RUNNERS)).level is Level.SKIP


def test_nobody_is_told_to_close_a_folder_of_all_programs(tmp_path: Path) -> None:
    shared = tmp_path / "shared"
    shared.mkdir()
    own = replace(ME, uid=tmp_path.stat().st_uid)
    for folder, mode, advice in ((shared, 0o1777, "name a socket in a folder"), (shared, 0o755, "chmod 0700")):
        folder.chmod(mode)
        check = socket_folder(folder / "bridge.sock", own)
        assert check.level is Level.FAIL and advice in check.advice
    assert "chmod" not in socket_folder(Path("/tmp/bridge.sock"), own).advice
    assert "chmod" not in socket_folder(shared / "bridge.sock", replace(own, uid=own.uid + 1)).advice


def test_a_socket_folder_that_is_not_there_yet_is_made_by_the_bridge(tmp_path: Path) -> None:
    assert socket_folder(tmp_path / "none" / "bridge.sock", ME).level is Level.SKIP


class FakeMeter:
    source = "ina3221 VDD_IN"
    caveat = "not at the wall"

    def read(self, now_ns: int) -> PowerSample:
        return PowerSample(now_ns, 12.5)


def meter(kind: str, open_it, sysfs_root: Path = Path("/nowhere"), user: UserRights = ME) -> Check:
    return power_meter(kind, open_it, sysfs_root, user, clock=lambda: 1, sleep=lambda _seconds: None)


def test_a_meter_names_its_rails_and_the_missing_consumers() -> None:
    check = meter("ina3221", FakeMeter)
    assert (check.level, check.found) == (Level.OK, "12.5 W, ina3221 VDD_IN, measured (not at the wall)")


def test_a_meter_that_cannot_be_read_is_a_warning() -> None:
    def refuse() -> FakeMeter:
        raise MeterError("rapl: readable by root only")

    check = meter("rapl", refuse)
    assert (check.level, check.found) == (Level.WARN, "rapl: readable by root only")
    assert meter("none", refuse).level is Level.SKIP


def test_temperatures_are_read_and_throttling_is_a_warning(tmp_path: Path) -> None:
    assert temperatures(tmp_path, 0).level is Level.SKIP
    zone, fan = "class/thermal/thermal_zone0", "class/thermal/cooling_device0"
    write(tmp_path, {f"{zone}/type": "tj-thermal\n", f"{zone}/temp": "81000\n"})
    assert "81 °C" in temperatures(tmp_path, 0).found
    write(tmp_path, {f"{fan}/type": "gpu-throttle-alert\n", f"{fan}/cur_state": "1\n"})
    assert temperatures(tmp_path, 0).level is Level.WARN


@pytest.mark.parametrize(
    ("temp_c", "level"), [(95.9, Level.OK), (96.1, Level.WARN), (99.5, Level.WARN), (101.6, Level.FAIL)]
)
def test_near_where_clocks_are_held_back_it_warns_and_near_the_end_it_fails(
    tmp_path: Path, temp_c: float, level: Level
) -> None:
    zone = "class/thermal/thermal_zone0"
    trips = {"0": ("passive", 99000), "1": ("critical", 104500)}
    files = {f"{zone}/trip_point_{number}_type": f"{kind}\n" for number, (kind, _) in trips.items()}
    files |= {f"{zone}/trip_point_{number}_temp": f"{milli_c}\n" for number, (_, milli_c) in trips.items()}
    write(tmp_path, {f"{zone}/type": "tj-thermal\n", f"{zone}/temp": f"{round(temp_c * 1000)}\n", **files})
    assert temperatures(tmp_path, 0).level is level


def test_an_energy_counter_that_only_root_may_read_is_a_warning_for_the_services_user(tmp_path: Path) -> None:
    counter = (
        write(tmp_path, {"class/powercap/intel-rapl:0/energy_uj": "1\n"}) / "class/powercap/intel-rapl:0/energy_uj"
    )
    rapl = FakeMeter()
    rapl.source = "rapl package-0"
    service = replace(ME, uid=4242, other=True)
    counter.chmod(0o400)
    assert meter("rapl", lambda: rapl, tmp_path, service).level is Level.WARN
    counter.chmod(0o444)
    assert meter("rapl", lambda: rapl, tmp_path, service).level is Level.OK


def test_a_restricted_node_adds_its_group(tmp_path: Path) -> None:
    (tmp_path / "dev").mkdir()
    (tmp_path / "dev" / "nvmap").touch()
    (tmp_path / "dev" / "nvmap").chmod(0o660)
    chgrp_to_a_group_of_no_power(tmp_path / "dev" / "nvmap")
    (node,) = device_nodes((CUDA,), tmp_path)
    assert node.path == Path("/dev/nvmap")
    assert node.group == grp.getgrgid((tmp_path / "dev" / "nvmap").stat().st_gid).gr_name


def test_a_node_of_the_root_group_does_not_put_the_runner_into_that_group() -> None:
    assert group_of(os.stat_result((stat.S_IFCHR | 0o660, 0, 0, 1, 0, 0, 0, 0, 0, 0))) is None


TRACED_CUDA_OPENS = (
    *("nvmap", "host1x-fence", "dri/renderD128", "dri/renderD129", "nvsciipc", "nvidia0", "nvidiactl"),
    *(f"nvgpu/igpu0/{name}" for name in ("as", "channel", "ctrl", "ctxsw", "nvsched", "power", "prof", "sched", "tsg")),
    *(f"nvhost-{name}-gpu" for name in ("as", "ctrl", "ctxsw", "nvsched", "power", "prof", "sched", "tsg")),
)
"""Nodes that public traces of CUDA on an Orin name; not tried on a board by this project."""


@pytest.mark.parametrize("provider", [CUDA, TENSORRT])
def test_nodes_that_cuda_opens_on_an_orin_are_let_through(tmp_path: Path, provider: str) -> None:
    write(tmp_path, dict.fromkeys((f"dev/{name}" for name in TRACED_CUDA_OPENS), ""))
    found = {str(node.path.relative_to("/dev")) for node in device_nodes((provider,), tmp_path)}
    assert found == set(TRACED_CUDA_OPENS)


def test_other_nodes_stay_closed_and_a_processor_needs_none(tmp_path: Path) -> None:
    write(tmp_path, dict.fromkeys((f"dev/{name}" for name in ["dri/card0", "sda", "video0", "mem", "nvme0n1"]), ""))
    assert device_nodes((CUDA, TENSORRT), tmp_path) == []
    write(tmp_path, dict.fromkeys((f"dev/{name}" for name in TRACED_CUDA_OPENS), ""))
    assert device_nodes(("CPUExecutionProvider",), tmp_path) == []


# --- the ONNX Runtime packages: two at once, a CPU build for a GPU target, missing libraries

GPU = (TENSORRT, CUDA, CPU_PROVIDER)
LIBRARIES = ("libnvinfer.so.10", "libcudart.so.12")


def runtime_check(
    root: Path, packages: dict[str, str], available: tuple[str, ...], libraries: tuple[str, ...] = LIBRARIES
) -> Check:
    folder = root / "usr/lib/aarch64-linux-gnu"
    folder.mkdir(parents=True)
    for library in libraries:
        (folder / library).touch()
    return onnx_runtime((TENSORRT, CUDA), available, packages.get, "aarch64", root)


def test_one_gpu_build_is_right(tmp_path: Path) -> None:
    assert runtime_check(tmp_path, {"onnxruntime-gpu": "1.23.0"}, GPU).level is Level.OK


def test_two_packages_at_once_are_refused_with_the_command_that_mends_it(tmp_path: Path) -> None:
    found = runtime_check(tmp_path, {"onnxruntime-gpu": "1.23.0", "onnxruntime": "1.31.1"}, GPU)
    assert found.level is Level.FAIL
    assert "pip uninstall -y onnxruntime onnxruntime-gpu" in found.advice and JETSON_INDEX in found.advice


def test_a_cpu_build_is_refused_for_a_gpu_target(tmp_path: Path) -> None:
    found = runtime_check(tmp_path, {"onnxruntime": "1.31.1"}, (CPU_PROVIDER,))
    assert found.level is Level.FAIL
    assert "pip uninstall -y onnxruntime;" in found.advice and "onnxruntime-gpu" in found.advice


@pytest.mark.parametrize("library", LIBRARIES)
def test_a_missing_library_is_named(tmp_path: Path, library: str) -> None:
    rest = tuple(name for name in LIBRARIES if name != library)
    found = runtime_check(tmp_path, {"onnxruntime-gpu": "1.23.0"}, GPU, rest)
    assert found.level is Level.FAIL and library.split(".")[0] in found.found and "nvidia-jetpack" in found.advice


def test_the_cpu_build_is_right_for_a_cpu_target(tmp_path: Path) -> None:
    found = onnx_runtime((CPU_PROVIDER,), (CPU_PROVIDER,), {"onnxruntime": "1.31.1"}.get, "x86_64", tmp_path)
    assert found.level is Level.OK


def test_a_missing_module_is_a_failed_check_that_names_the_package(tmp_path: Path) -> None:
    found = onnx_runtime((), (), {}.get, "x86_64", tmp_path)
    assert found.level is Level.FAIL and found.advice.endswith("pip install --force-reinstall onnxruntime")
