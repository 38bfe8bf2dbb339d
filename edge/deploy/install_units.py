"""`edge-install units`: collects the units' inputs, writes and checks the units; starts nothing."""

from __future__ import annotations

import argparse
import os
import shlex
import shutil
import socket
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from ipaddress import IPv4Network
from pathlib import Path
from typing import Any, Final

import psutil

from edge.artifacts.files import ArtifactError, read_manifest, read_manifest_bytes
from edge.artifacts.manifest import Artifacts, load_artifacts
from edge.artifacts.providers import device_nodes
from edge.artifacts.target_facts import TargetFacts, target_facts
from edge.artifacts.trust import STATE_DIRECTORY, Trust
from edge.core.cli import EXIT_CHECK_FAILED, EXIT_DONE, write_result
from edge.deploy import units
from edge.deploy.link_rights import Addresses, link_rights, robot_networks
from edge.deploy.releases import LINK, home_argument
from edge.deploy.unit_check import MAX_EXPOSURE, UnitVerdict, check_units, systemd_version
from edge.deploy.unit_files import check_writers, unreadable, write_units
from edge.deploy.unit_text import (
    BRIDGE_USER,
    OPERATOR_GROUP,
    RUNNER_USER,
    SYSUSERS_FILE,
    ServiceUsers,
    UnitError,
    sysusers,
)
from edge.inference import engines
from edge.reasoning.prompt import InstructionError, check_instruction
from edge.run.instructions import check_first_instruction
from firmware_bridge.core.config import RobotConfig, load_robot_config
from firmware_bridge.system.input_file import read_text

PROGRAMS: Final = ("edge-bridge", "edge-run")
SYSTEM_UNITS: Final = Path("etc/systemd/system")
SYSTEM_USERS: Final = Path("etc/sysusers.d")
SYSTEM_RULES: Final = units.FIREWALL_FOLDER.relative_to("/")
_MAX_INSTRUCTION_BYTES: Final = 16_384


def interface_addresses() -> Addresses:
    """This machine's interfaces."""
    return {
        name: [(entry.address, entry.netmask) for entry in entries if entry.family == socket.AF_INET and entry.netmask]
        for name, entries in psutil.net_if_addrs().items()
    }


def nft_program() -> Path | None:
    """Return the program that loads firewall rules; None: not installed."""
    found = shutil.which("nft", path="/usr/sbin:/sbin:/usr/bin")
    return None if found is None else Path(found)


@dataclass(frozen=True)
class Host:
    """Access to the machine; tests replace it."""

    root: Path = Path("/")
    addresses: Callable[[], Addresses] = interface_addresses
    nft: Callable[[], Path | None] = nft_program
    check: Callable[[Sequence[Path]], UnitVerdict] = check_units
    systemd: Callable[[], int | None] = systemd_version
    programs: Path = field(default_factory=lambda: Path(sys.executable).parent)
    python: Path = field(default_factory=lambda: Path(sys.executable))
    prefixes: tuple[Path, ...] = field(
        default_factory=lambda: (Path(sys.prefix), Path(sys.base_prefix), Path(__file__).resolve().parents[2])
    )


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Command line of `edge-install units`."""
    parser.add_argument("--artifacts", type=Path, required=True, metavar="DIR", help="directory made by edge-export")
    parser.add_argument("--robot", type=Path, required=True, metavar="FILE.toml", help="the robot and its limits")
    text = parser.add_mutually_exclusive_group(required=True)
    text.add_argument("--instruction", metavar="TEXT", help="instruction for the robot, in a sentence")
    text.add_argument("--instruction-file", type=Path, metavar="FILE", help="the same, read from a file now")
    place = parser.add_mutually_exclusive_group(required=True)
    place.add_argument("--out", type=Path, metavar="DIR", help="write the files here, to be read or copied")
    place.add_argument("--system", action="store_true", help="write them to where systemd reads them (needs root)")
    parser.add_argument(
        "--home", type=home_argument, metavar="DIR",
        help="run the release that DIR/current leads to (edge-install board), instead of this installation",
    )  # fmt: skip
    parser.add_argument("--target", metavar="NAME", help="refuse artifacts of any other target")
    parser.add_argument("--engines", type=Path, metavar="DIR", help="engines (default: ARTIFACTS.engines)")
    parser.add_argument("--trust", type=Path, metavar="KEY.pub", help="run only artifacts that this key has signed")
    for option, default, purpose in (
        ("--bridge-user", BRIDGE_USER, "user of the bridge"),
        ("--runner-user", RUNNER_USER, "user of the runner"),
        ("--operator-group", OPERATOR_GROUP, "group of the people that may stop and arm"),
    ):
        parser.add_argument(option, default=default, metavar="NAME", help=f"{purpose} (default: {default})")
    parser.add_argument(
        "--network",
        action="append",
        default=[],
        metavar="CIDR",
        help="the robot's network, IPv4, at most a /16, may be repeated (default: that of the robot file's interface, "
        "and its peers)",
    )
    parser.add_argument(
        "--arm-at-start",
        action="store_true",
        help="a robot file without operator_arm is meant: the runner drives as soon as it starts",
    )
    parser.add_argument("--force", action="store_true", help="replace files that are there and differ")
    parser.add_argument("--json", metavar="FILE|-", help="write the result as JSON")


def run(args: argparse.Namespace, say: Callable[[str], None], host: Host | None = None) -> int:
    """Write the units and check them; return the exit code.

    Raises UnitError, ConfigError, InstructionError, KeyFileError or OSError for bad input, ArtifactError for artifacts
    to be refused.
    """
    host = host or Host()
    if args.home is not None:
        host = of_release(host, args.home.absolute())
    inputs = gather(args, host)
    if set(inputs.providers) & set(units.NEED_DEVICES) and not inputs.devices:
        lacking = "no device of " + " or ".join(inputs.providers) + " is on this machine"
        if args.system:
            raise ArtifactError(f"{lacking}: the runner could not start; install on the device that it is made for")
        say(f"{lacking}: run this on the device itself before you use the runner's unit")
    # An emergency stop's input may appear at start-up only; a missing calibration is refused here.
    needed = [inputs.robot, inputs.artifacts, *(path for path in inputs.robot_files if not path.is_relative_to("/sys"))]
    needed += [] if inputs.trust is None else [inputs.trust]
    if inputs.engines is not None and inputs.engines.is_dir():
        needed.append(inputs.engines)
    elif inputs.engines is not None:
        say(f"{inputs.engines}: not there yet; build it before the runner starts: edge-install engines")
    if inputs.operator_arm and args.arm_at_start:
        say(f"{inputs.robot}: has operator_arm, so --arm-at-start changes nothing: the bridge waits for an operator")
    check_writers([*needed, *(inputs.programs / name for name in PROGRAMS)])
    closed = unreadable(needed)
    for path in closed:
        say(f"{path}: the services cannot read it unless it is theirs: chmod o+rX {shlex.quote(str(path))}")
    if (secret := inputs.link.secret) is not None:
        key, user = shlex.quote(str(secret)), inputs.users.bridge
        say(f"{secret}: only the bridge may read it: sudo chown {user}: {key} && sudo chmod 0600 {key}")
    _report_firewall(inputs, say)
    contents = _contents(args, inputs, host)
    written = write_units(contents, force=args.force)
    for path in contents:
        say(f"{path}: {'written' if path in written else 'is up to date'}")
    verdict = host.check([path for path in contents if path.suffix == ".service"])
    _report(verdict, say)
    commands = _commands(contents, inputs, system=args.system)
    say("nothing was enabled or started. To do so, while the robot stands: a service that runs already is ended and")
    say("started again. The last command lets the robot stand up and drive:")
    for command in commands:
        say(f"  {command}")
    stop = _bridge_command("stop", inputs)
    say("emergency stop, at any time; only `edge-bridge arm` takes it back:")
    say(f"  {stop}")
    result: dict[str, Any] = {
        "files": [str(path) for path in contents],
        "written": [str(path) for path in written],
        "verify": list(verdict.complaints),
        "verify_other_units": list(verdict.others),
        "exposure": verdict.exposure,
        "max_exposure": MAX_EXPOSURE,
        "not_checked": list(verdict.not_checked),
        "unreadable": [str(path) for path in closed],
        "commands": commands,
        "stop": stop,
    }
    write_result(args.json, result)
    return EXIT_DONE if verdict.good else EXIT_CHECK_FAILED


def of_release(host: Host, home: Path) -> Host:
    """Return the machine with the programs of the current release, which an update or a rollback changes."""
    programs = home / LINK / "venv/bin"
    return replace(host, programs=programs, python=programs / "python", prefixes=(home, Path(sys.base_prefix)))


def gather(args: argparse.Namespace, host: Host) -> units.ServiceInputs:
    """Collect the units' inputs from the arguments, the artifacts, the robot file and the machine."""
    robot = load_robot_config(args.robot, socket=units.SOCKET)
    if not robot.safety.operator_arm and not args.arm_at_start:
        raise UnitError(
            f"robot file {args.robot}: safety.operator_arm: expected true, found false: the service would drive as "
            f"soon as it starts; set it to true, or give --arm-at-start if you want that"
        )
    above = args.artifacts.absolute().parents
    links = [path for path in above if path.name == LINK and path.is_symlink() and (path / "venv/bin").is_dir()]
    if args.home is None and links:
        raise UnitError(
            f"--artifacts {args.artifacts}: leads through {links[0]}: expected --home {links[0].parent}, found none; "
            f"without it the services stay on this release, which a later update removes"
        )
    # A path through the link of the releases stays one, so that an update changes programs and artifacts together.
    through_link = args.home is not None and args.artifacts.absolute().is_relative_to(args.home.absolute() / LINK)
    artifacts = load_artifacts(args.artifacts.absolute() if through_link else Path(os.path.realpath(args.artifacts)))
    if args.trust is not None:
        Trust(args.trust, STATE_DIRECTORY / "release.json").check(
            artifacts.directory, read_manifest_bytes(artifacts.directory)
        )
    facts = target_facts(read_manifest(artifacts.directory))
    if facts is None:
        raise ArtifactError(f"{artifacts.directory}: its manifest has no target; export again")
    if args.target is not None and args.target != artifacts.target:
        raise ArtifactError(
            f"{artifacts.directory}: made for {artifacts.target}, expected {args.target}; export for {args.target}"
        )
    for program in PROGRAMS:
        if not (host.programs / program).exists():
            raise UnitError(f"{host.programs / program}: missing; install the package there: pip install tic-vla-edge")
    dds = robot.dds
    if dds is None and args.network:
        raise UnitError(f"--network: expected none, found {args.network[0]}: protocol {robot.protocol} uses no DDS")
    providers = tuple(sorted({graph.session.provider for graph in artifacts.graphs.values()}))
    nodes = device_nodes(providers, host.root)
    folder = None
    if engines.needed(artifacts):
        folder = args.engines or engines.default_directory(artifacts.directory)
        folder = folder if through_link and args.engines is None else Path(os.path.realpath(folder))
    return units.ServiceInputs(
        programs=host.programs,
        python=host.python,
        prefixes=host.prefixes,
        robot=Path(os.path.realpath(args.robot)),
        robot_files=_robot_files(robot),
        artifacts=artifacts.directory,
        engines=folder,
        trust=None if args.trust is None else Path(os.path.realpath(args.trust)),
        instruction=check_first_instruction(_instruction(args)),
        users=ServiceUsers(args.bridge_user, args.runner_user, args.operator_group),
        interface="" if dds is None else dds.interface,
        domain=0 if dds is None else dds.domain,
        networks=() if dds is None else robot_networks(dds, args.network, host.addresses),
        own=tuple(IPv4Network(address) for address, _ in host.addresses().get(dds.interface if dds else "", ())),
        nft=host.nft(),
        providers=providers,
        devices=tuple(node.path for node in nodes),
        groups=tuple(sorted({node.group for node in nodes if node.group is not None})),
        memory_bytes=None if facts.own_memory else facts.available_bytes,
        control_priority=artifacts.runtime.control_priority,
        operator_arm=robot.safety.operator_arm,
        bridge_cores=_bridge_cores(artifacts, facts),
        systemd=host.systemd(),
        link=link_rights(robot),
    )


def _robot_files(robot: RobotConfig) -> tuple[Path, ...]:
    """Return the files outside the package that the robot file names, without the bridge's secret."""
    files = (robot.odometry.calibration, robot.safety.estop_file, None if robot.can is None else robot.can.dbc)
    return tuple(path for path in files if path is not None and path.is_absolute())


def _instruction(args: argparse.Namespace) -> str:
    if args.instruction_file is None:
        return str(args.instruction)
    try:
        return check_instruction(read_text(args.instruction_file, _MAX_INSTRUCTION_BYTES))
    except UnicodeDecodeError:
        raise UnitError(f"--instruction-file {args.instruction_file}: not UTF-8 text") from None
    except InstructionError as error:
        raise UnitError(f"--instruction-file {args.instruction_file}: {error}") from error
    except OSError as error:
        raise UnitError(f"--instruction-file {args.instruction_file}: {error.strerror}") from error


def _bridge_cores(artifacts: Artifacts, facts: TargetFacts) -> tuple[int, ...]:
    """Return the cores that the target gives to neither thread of the runner; none if it gives no cores."""
    taken = {*artifacts.runtime.control_cores, *artifacts.runtime.reasoning_cores}
    return tuple(sorted(set(range(facts.cores)) - taken)) if taken else ()


def _contents(args: argparse.Namespace, inputs: units.ServiceInputs, host: Host) -> dict[Path, str]:
    """Return the text of every file by its path."""
    folder = host.root / SYSTEM_UNITS if args.system else args.out.absolute()
    contents = {
        folder / units.BRIDGE_UNIT: units.bridge_unit(inputs),
        folder / units.RUNNER_UNIT: units.runner_unit(inputs),
    }
    users = host.root / SYSTEM_USERS if args.system else folder
    contents[users / SYSUSERS_FILE] = sysusers(inputs.users)
    if inputs.on_cable:
        rules = host.root / SYSTEM_RULES if args.system else folder
        contents[rules / units.FIREWALL_FILE] = units.firewall_rules(inputs)
        if inputs.nft is not None:
            contents[folder / units.FIREWALL_UNIT] = units.firewall_unit(inputs)
    return contents


def _report_firewall(inputs: units.ServiceInputs, say: Callable[[str], None]) -> None:
    if not inputs.on_cable:
        return
    if inputs.nft is None:
        say("nft is not on this machine, so nothing loads the firewall: sudo apt install nftables, then run this again")
    say("the firewall ends every SSH session over the robot's cable: run the commands over another interface")
    wide = [network for network in inputs.networks if network.prefixlen < 32]
    if wide:
        say(
            f"the firewall lets {', '.join(map(str, wide))} through: give the robot's own address with --network, e.g. "
            f"192.168.123.161/32, to let only the robot through"
        )


def _report(verdict: UnitVerdict, say: Callable[[str], None]) -> None:
    for line in verdict.complaints:
        say(f"verify: {line}")
    for line in verdict.others:
        say(f"verify, about other units of this machine: {line}")
    for name, score in verdict.exposure.items():
        judged = "at most" if score <= MAX_EXPOSURE else "above"
        say(f"{name}: exposure {score}, {judged} {MAX_EXPOSURE}")
    for line in verdict.not_checked:
        say(f"skipped: {line}")


def _commands(contents: Mapping[Path, str], inputs: units.ServiceInputs, *, system: bool) -> list[str]:
    """Return the commands with which the operator starts the services."""
    prepare = (
        [] if system else [f"sudo install -D -m 0644 {shlex.quote(str(path))} {_home_of(path)}" for path in contents]
    )
    prepare += ["sudo systemd-sysusers", f'sudo usermod -aG {inputs.users.operators} "$USER"']
    firewall = [path.name for path in contents if path.name == units.FIREWALL_UNIT]
    # Restarted, not started: a service that runs already would keep the instruction and limits of its old unit.
    services = [*firewall, units.BRIDGE_UNIT, units.RUNNER_UNIT]
    # Not enabled if it arms by itself: after a brown-out the machine must not drive before a person has checked it.
    enabled = services if inputs.operator_arm else services[:-1]
    return [
        *prepare,
        "sudo systemctl daemon-reload",
        *(f"sudo systemctl enable {unit}" for unit in enabled),
        *(f"sudo systemctl restart {unit}" for unit in services),
        *([_bridge_command("arm", inputs)] if inputs.operator_arm else []),
    ]


def _bridge_command(command: str, inputs: units.ServiceInputs) -> str:
    bridge, robot = shlex.quote(str(inputs.programs / "edge-bridge")), shlex.quote(str(inputs.robot))
    return f"sudo {bridge} {command} --robot {robot} --socket {units.SOCKET}"


def _home_of(path: Path) -> str:
    folders = {".conf": SYSTEM_USERS, ".nft": SYSTEM_RULES}
    return f"/{folders.get(path.suffix, SYSTEM_UNITS) / path.name}"
