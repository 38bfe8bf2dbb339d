"""Formats the systemd units of bridge and runner for one robot and one artifact directory; touches no file.

Two services of two users. The bridge stops the robot and outlives the runner: it starts first, ends last, is restarted
without limit, and the kernel kills it last when memory runs out. The kernel kills the runner first, and its end stops
the robot. systemd restarts the bridge, and a runner that waits for an operator, within seconds; the bridge's deadman
stops the robot within milliseconds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from ipaddress import IPv4Network, collapse_addresses
from pathlib import Path
from typing import Final

from edge.artifacts.trust import STATE_DIRECTORY
from edge.core.device import CUDA, OPENVINO, TENSORRT
from edge.deploy import firewall
from edge.deploy.link_rights import DDS_ONLY, LinkRights, check_network, device_lines
from edge.deploy.unit_text import ServiceUsers, Setting, UnitError, argument, bound, render, word
from firmware_bridge.core.config import BRIDGE_PRIORITY

BRIDGE_UNIT: Final = "tic-vla-edge-bridge.service"
RUNNER_UNIT: Final = "tic-vla-edge-runner.service"
FIREWALL_UNIT: Final = "tic-vla-edge-firewall.service"
FIREWALL_FILE: Final = "tic-vla-edge.nft"
FIREWALL_FOLDER: Final = Path("/etc/tic-vla-edge")
SOCKET: Final = Path("/run/tic-vla-edge/bridge.sock")
LATCH: Final = Path("/var/lib/tic-vla-edge-bridge/emergency-stop")
"""File that keeps an emergency stop over restarts of the bridge and of the machine."""
FLIGHT_LOG: Final = f'"{STATE_DIRECTORY}/flight-${{INVOCATION_ID}}.mcap"'
"""Flight log of one start: systemd gives every start of a service another invocation id."""
RESTART_STEPS_SINCE: Final = 254
"""First version of systemd with RestartSteps= (its NEWS file)."""
BRIDGE_MEMORY: Final = "256M"
RUNNER_MEMORY_SHARE: Final = "75%"
"""Share of the machine's memory for the runner where the target gives none; a choice of ours."""
HIDDEN: Final = ("/home", "/root", "/run/user", "/tmp", "/var/tmp")
"""Folders hidden from a hardened service; units bind only the required files from there."""

_COMPILES: Final = (CUDA, TENSORRT, OPENVINO)
NEED_DEVICES: Final = (CUDA, TENSORRT)
"""Providers that compute on something other than the processor."""


@dataclass(frozen=True)
class ServiceInputs:
    """All inputs of the units; paths absolute."""

    programs: Path
    """Folder of `edge-bridge` and `edge-run`."""
    python: Path
    """Their Python interpreter."""
    prefixes: tuple[Path, ...]
    """Folders that Python itself and its packages are read from."""
    robot: Path
    robot_files: tuple[Path, ...]
    """Files that the robot file names."""
    artifacts: Path
    engines: Path | None
    trust: Path | None
    """Public key whose signature the artifacts need."""
    instruction: str
    users: ServiceUsers
    interface: str
    """The robot file's interface; "lo": a simulated robot on this machine, without network target and filter. Empty
    without DDS."""
    domain: int
    """DDS domain."""
    networks: tuple[IPv4Network, ...]
    """Networks of the robot; none without DDS."""
    own: tuple[IPv4Network, ...]
    """This machine's addresses on that interface, by which the bridge detects other local programs' requests."""
    nft: Path | None
    """Program that loads the firewall; None: this machine has none."""
    providers: tuple[str, ...]
    """ONNX Runtime's execution providers that the graphs use."""
    devices: tuple[Path, ...]
    """Device nodes that those providers need, as found on the machine."""
    groups: tuple[str, ...]
    """Groups that may open these nodes."""
    memory_bytes: int | None
    """Memory limit of the runner, bytes; None: the target gives its graphics card's only, so the limit is a share of
    the machine's."""
    control_priority: int
    operator_arm: bool
    """Whether every arming needs an operator; False: the runner arms by itself, by explicit consent."""
    bridge_cores: tuple[int, ...]
    """Cores that the target leaves to neither of the runner's threads; empty: any."""
    systemd: int | None
    """Version of the machine's systemd; None: unknown, so only keys of version 249 are written."""
    link: LinkRights = DDS_ONLY

    def __post_init__(self) -> None:
        for name in ("programs", "python", "robot", "artifacts", *(("engines",) if self.engines else ())):
            if not getattr(self, name).is_absolute():
                raise UnitError(f"{name} {getattr(self, name)}: expected an absolute path")
        for program in (self.programs, self.python):
            if set(str(program)) & set("'\"\\"):
                raise UnitError(f"{program}: systemd takes no program with quotes or backslashes in its path; move it")
        if self.link.uses_dds and not self.networks:
            raise UnitError("the robot's network is unknown: give it with --network, e.g. 192.168.123.0/24")
        for network in collapse_addresses(self.networks):
            check_network(network, "networks")
        if (self.memory_bytes is not None and self.memory_bytes <= 0) or not 0 <= self.control_priority <= 99:
            raise UnitError(
                f"memory {self.memory_bytes} bytes, priority {self.control_priority}: expected > 0, 0 to 99"
            )
        if self.control_priority >= BRIDGE_PRIORITY:
            raise UnitError(
                f"the target's control_priority {self.control_priority} must be below the bridge's {BRIDGE_PRIORITY}: "
                f"export again with --set runtime.control_priority=50"
            )

    @property
    def on_cable(self) -> bool:
        """Whether the robot's DDS comes over a network interface, which needs a firewall."""
        return self.link.uses_dds and self.interface != "lo"


def bridge_unit(inputs: ServiceInputs) -> str:
    """Return the bridge's unit."""
    users, secret = inputs.users, (inputs.link.secret,) if inputs.link.secret is not None else ()
    command = [word(str(inputs.programs / "edge-bridge"))]
    options = ("--robot", str(inputs.robot), "--socket", str(SOCKET), "--latch", str(LATCH))
    groups = ("--runner-group", users.runner, "--operator-group", users.operators)
    command += [argument(text) for text in (*options, *groups)]
    service: list[Setting | str] = [
        ("Type", "notify"),
        ("NotifyAccess", "main"),
        ("ExecStart", " ".join(command)),
        ("User", users.bridge),
        "It gives its sockets to these groups; the runner is not in the second, so it can take back no emergency stop.",
        ("SupplementaryGroups", " ".join((users.runner, users.operators, *inputs.link.bridge_groups))),
        *_ending(watchdog_s=1, start_s=20, stop_s=2),
        "Always, also after a clean exit: without it nothing can stop the robot.",
        ("Restart", "always"),
        *_back_off(inputs.systemd),
        "Before everything else on its core; systemd-wide throttling of real-time tasks still lets the system breathe.",
        ("CPUSchedulingPolicy", "fifo"),
        ("CPUSchedulingPriority", str(BRIDGE_PRIORITY)),
        *([("CPUAffinity", " ".join(map(str, inputs.bridge_cores)))] if inputs.bridge_cores else []),
        ("LimitRTPRIO", str(BRIDGE_PRIORITY)),
        "A thread that spins, as in a flood of packets: after 5 s without a pause the bridge stops the robot and ends;",
        "later it is killed. Start-up takes less.",
        ("LimitRTTIME", "5s:8s"),
        "This limit counts addresses, of which Python and DDS reserve far more than they use; MemoryMax counts pages.",
        ("LimitMEMLOCK", "infinity"),
        ("OOMScoreAdjust", "-900"),
        ("MemoryMax", BRIDGE_MEMORY),
        ("MemorySwapMax", "0"),
        ("TasksMax", "64"),
        ("RuntimeDirectory", SOCKET.parent.name),
        "Other users pass through to the sockets, whose modes decide, and write nothing here: clients rely on that.",
        ("RuntimeDirectoryMode", "0711"),
        ("RuntimeDirectoryPreserve", "restart"),
        "Keeps an emergency stop over restarts and reboots until a person ends it.",
        ("StateDirectory", LATCH.parent.name),
        ("StateDirectoryMode", "0700"),
        *_hardening(inputs, (inputs.robot, *inputs.robot_files, *secret), bridge=True),
        *(device_lines(inputs.link.bridge_devices, ()) or [("PrivateDevices", "yes")]),
        ("ProcSubset", "pid"),
        ("MemoryDenyWriteExecute", "yes"),
        ("SystemCallFilter", "@system-service"),
        ("SystemCallFilter", "~@privileged @resources"),
        "For the groups of its sockets; no PrivateUsers, in which those groups do not exist.",
        ("SystemCallFilter", "chown fchownat"),
        "For the threads of its robot's link, which get less than its own priority.",
        ("SystemCallFilter", "sched_setscheduler"),
    ]
    unit: list[Setting | str] = [
        ("Description", "tic-vla-edge bridge: the only process that commands the robot"),
        "Ordered after no network: the bridge itself waits for its interface, and takes an emergency stop meanwhile.",
        "No limit of starts: a robot must not be left without a bridge.",
        ("StartLimitIntervalSec", "0"),
        *_behind_firewall(inputs),
    ]
    return _render("bridge", {"Unit": unit, "Service": service, "Install": [("WantedBy", "multi-user.target")]})


def runner_unit(inputs: ServiceInputs) -> str:
    """Return the runner's unit."""
    engines = () if inputs.engines is None else ("--engines", str(inputs.engines))
    paths = ("--artifacts", str(inputs.artifacts), *engines, "--robot", str(inputs.robot), "--socket", str(SOCKET))
    command = [word(str(inputs.programs / "edge-run")), *(argument(text) for text in paths)]
    # One word with its text, so that a text that begins with a dash is no option.
    command.append(argument(f"--instruction={inputs.instruction}"))
    command += [argument("--record"), FLIGHT_LOG, *([argument("--require-operator")] if inputs.operator_arm else [])]
    if inputs.trust is not None:
        # The newest release that was run is remembered where the service may write.
        command += [argument(text) for text in ("--trust", str(inputs.trust), "--state", str(STATE_DIRECTORY))]
    cleaning = ("-I", "-m", "edge.flightlog.cleanup", str(STATE_DIRECTORY))
    optional = tuple(path for path in (inputs.engines, inputs.trust) if path is not None)
    needed = (inputs.robot, *inputs.robot_files, inputs.artifacts, *optional)
    arms = "--arm-at-start was given: this stands the robot up and drives by itself whenever it starts."
    if inputs.operator_arm:
        arms = "Stands the robot up and drives after `edge-bridge arm` only, once for each; until then it waits."
    service: list[Setting | str] = [
        ("Type", "notify"),
        ("NotifyAccess", "main"),
        "A recording bounds itself, all of them together do not: the oldest are deleted; starting does not hang on it.",
        ("ExecStartPre", "-" + " ".join([word(str(inputs.python)), *(argument(text) for text in cleaning)])),
        arms,
        ("ExecStart", " ".join(command)),
        ("User", inputs.users.runner),
        "ONNX Runtime 1.29 and later keeps a device id and reports to its maker, unless told not to before it starts.",
        ("Environment", "ORT_DISABLE_TELEMETRY=1"),
        *_ending(watchdog_s=3, start_s=180, stop_s=10),
        *_starting_again(inputs),
        "The runner gives its threads real-time priorities by itself; the control thread has the highest.",
        ("LimitRTPRIO", str(inputs.control_priority)),
        ("LimitMEMLOCK", "infinity"),
        "Dies first, and never makes the bridge wait for memory.",
        ("OOMScoreAdjust", "500"),
        ("OOMPolicy", "kill"),
        ("MemoryMax", RUNNER_MEMORY_SHARE if inputs.memory_bytes is None else str(inputs.memory_bytes)),
        ("MemorySwapMax", "0"),
        ("TasksMax", "512"),
        ("StateDirectory", STATE_DIRECTORY.name),
        ("StateDirectoryMode", "0700"),
        *_hardening(inputs, needed, bridge=False),
        *_accelerator(inputs),
        ("SystemCallFilter", "@system-service"),
        ("SystemCallFilter", "~@privileged"),
    ]
    unit = [
        ("Description", "tic-vla-edge runner: drives the robot by its instruction"),
        "Wants and not Requires: a bridge that restarts must not start the robot again by restarting the runner, whose",
        "connection ends with the old bridge. After: at shutdown the runner stops first.",
        ("Wants", BRIDGE_UNIT),
        ("After", BRIDGE_UNIT),
        *([] if not inputs.on_cable else [("Wants", "network-online.target"), ("After", "network-online.target")]),
        *_behind_firewall(inputs),
        # A start that fails slowly must be counted too, so the window holds several of the longest starts.
        ("StartLimitIntervalSec", "900"),
        ("StartLimitBurst", "5"),
    ]
    return _render("runner", {"Unit": unit, "Service": service, "Install": [("WantedBy", "multi-user.target")]})


def _starting_again(inputs: ServiceInputs) -> list[Setting | str]:
    if not inputs.operator_arm:
        return [
            "A runner that arms by itself would drive on after a crash, before a person has seen the robot.",
            ("Restart", "no"),
        ]
    return [
        "After a signal, a time-out or the watchdog. An exit with a code is a decision, such as a fault that latched:",
        "only the operator starts the robot again after it.",
        ("Restart", "on-abnormal"),
        ("RestartSec", "2s"),
    ]


def firewall_unit(inputs: ServiceInputs) -> str:
    """Return the unit that loads the firewall's file at boot. Raises UnitError without a program that loads it."""
    if inputs.nft is None:
        raise UnitError("no program loads the firewall: install nftables")
    nft, file = word(str(inputs.nft)), argument(str(FIREWALL_FOLDER / FIREWALL_FILE))
    service: list[Setting | str] = [
        ("Type", "oneshot"),
        ("RemainAfterExit", "yes"),
        ("ExecStart", f"{nft} -f {file}"),
        ("ExecReload", f"{nft} -f {file}"),
        ("ExecStop", f"{nft} delete table inet {firewall.TABLE}"),
        ("IPAddressDeny", "any"),
        ("RestrictAddressFamilies", "AF_NETLINK AF_UNIX"),
        ("CapabilityBoundingSet", "CAP_NET_ADMIN"),
        ("PrivateDevices", "yes"),
        ("ProcSubset", "pid"),
        ("ProtectHome", "yes"),
        ("MemoryDenyWriteExecute", "yes"),
        ("RestrictRealtime", "yes"),
        *_confinement(),
        ("SystemCallFilter", "@system-service"),
        ("SystemCallFilter", "~@privileged @resources"),
    ]
    unit: list[Setting | str] = [
        ("Description", "tic-vla-edge firewall of the robot's cable"),
        ("Before", f"{BRIDGE_UNIT} {RUNNER_UNIT}"),
    ]
    return _render("firewall", {"Unit": unit, "Service": service, "Install": [("WantedBy", "multi-user.target")]})


def firewall_rules(inputs: ServiceInputs) -> str:
    """Return the nftables file; raises UnitError for an interface without a name."""
    users = (inputs.users.bridge, inputs.users.runner)
    return firewall.ruleset(inputs.interface, inputs.networks, inputs.domain, users)


def _render(which: str, sections: dict[str, list[Setting | str]]) -> str:
    comment = [f"Made by edge-install units: the {which} of one robot. Generate it again, do not edit it; see also"]
    return render([*comment, "systemctl edit, which keeps changes of yours apart."], sections)


def _behind_firewall(inputs: ServiceInputs) -> list[Setting | str]:
    """Return the firewall's dependency: Wants, not Requires, since the robot needs a bridge without firewall too."""
    if not inputs.on_cable or inputs.nft is None:
        return []
    return [("Wants", FIREWALL_UNIT), ("After", FIREWALL_UNIT)]


def _back_off(systemd: int | None) -> list[Setting | str]:
    """Return the delays between restarts of the bridge: short after a crash, longer for a persistent failure."""
    if systemd is None or systemd < RESTART_STEPS_SINCE:
        return [("RestartSec", "1s")]
    return [("RestartSec", "100ms"), ("RestartSteps", "5"), ("RestartMaxDelaySec", "5s")]


def _ending(*, watchdog_s: int, start_s: int, stop_s: int) -> list[Setting | str]:
    return [
        ("TimeoutStartSec", str(start_s)),
        ("WatchdogSec", str(watchdog_s)),
        "SIGABRT does not reach a stopped process (systemd issue 1970); nothing is gained by a core dump either.",
        ("WatchdogSignal", "SIGKILL"),
        ("TimeoutAbortSec", "1"),
        ("LimitCORE", "0"),
        ("KillMode", "mixed"),
        ("TimeoutStopSec", str(stop_s)),
    ]


def _hardening(inputs: ServiceInputs, needed: Sequence[Path], *, bridge: bool) -> list[Setting | str]:
    """Return the restrictions of both services; `needed`: paths that they read besides Python."""
    link = inputs.link
    dds = (*inputs.networks, *inputs.own, firewall.MULTICAST) if link.uses_dds else ()
    other = link.host if bridge else link.camera_host
    networks = " ".join(dict.fromkeys(str(network) for network in (*dds, other) if network is not None))
    families = ("AF_UNIX", *(("AF_INET",) if networks else ()), "AF_NETLINK", *(link.families if bridge else ()))
    hidden = sorted({str(path) for path in (*inputs.prefixes, *needed) if is_hidden(path)})
    return [
        "The robot's network and nothing else: its body is an unauthenticated peer.",
        ("IPAddressDeny", "any"),
        *((("IPAddressAllow", networks),) if networks else ()),
        ("RestrictAddressFamilies", " ".join(families)),
        ("CapabilityBoundingSet", ""),
        ("ProtectHome", "tmpfs" if hidden else "yes"),
        *((("BindReadOnlyPaths", " ".join(bound(path) for path in hidden)),) if hidden else ()),
        "A /tmp of its own: Unitree's SDK writes /tmp/cdds.LOG, which another user could have put there.",
        *_confinement(),
    ]


def _confinement() -> list[Setting | str]:
    """Return the restrictions that suit all services."""
    return [
        ("NoNewPrivileges", "yes"),
        ("AmbientCapabilities", ""),
        ("ProtectSystem", "strict"),
        ("PrivateTmp", "yes"),
        ("PrivateMounts", "yes"),
        ("ProtectProc", "invisible"),
        ("ProtectClock", "yes"),
        ("ProtectHostname", "yes"),
        ("ProtectKernelTunables", "yes"),
        ("ProtectKernelModules", "yes"),
        ("ProtectKernelLogs", "yes"),
        ("ProtectControlGroups", "yes"),
        ("DevicePolicy", "closed"),
        ("RestrictNamespaces", "yes"),
        ("RestrictSUIDSGID", "yes"),
        ("LockPersonality", "yes"),
        ("RemoveIPC", "yes"),
        ("KeyringMode", "private"),
        ("UMask", "0077"),
        "A call outside the list fails like one without permission, which the program survives.",
        ("SystemCallErrorNumber", "EPERM"),
        ("SystemCallArchitectures", "native"),
    ]


def is_hidden(path: Path) -> bool:
    """Return whether a path is hidden from a hardened service unless it is bound."""
    return any(path.is_relative_to(folder) for folder in HIDDEN)


def _accelerator(inputs: ServiceInputs) -> list[Setting | str]:
    """Return the runner's device access: its camera's and the nodes of the graphs' providers, none on a processor."""
    camera, groups = inputs.link.camera_devices, inputs.link.camera_groups
    if not set(inputs.providers) & set(_COMPILES):
        # No PrivateUsers: it hides the bridge's user id, by which the runner recognises an impostor.
        return [*(device_lines(camera, groups) or [("PrivateDevices", "yes")]), ("MemoryDenyWriteExecute", "yes")]
    needs = set(inputs.providers) & set(NEED_DEVICES) and not inputs.devices
    missing = ["DeviceAllow= is missing: no device of these providers was found where this was written."]
    nodes = (*(word(str(node)) for node in inputs.devices), *camera)
    return [
        "These providers compile code at run time and use devices: no PrivateDevices, no MemoryDenyWriteExecute.",
        *(missing if needs else ()),
        *device_lines(nodes, tuple(dict.fromkeys((*inputs.groups, *groups)))),
    ]
