"""Table of all commands: a row adds a command to the tests of bad input."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import firmware_bridge
from edge.commands import COMMANDS
from tests.support.bad_input.harness import Command
from tests.support.bad_input.values import (
    choices,
    directories,
    json_files,
    numbers,
    other_files,
    output_directories,
    outputs,
    texts,
    toml_files,
    unreadable_directories,
)

ROBOT: Final = Path(firmware_bridge.__file__).parent / "robots" / "go2_sim.toml"
seconds = numbers("-1", "0")
counts = numbers("-1", "1.5")
instructions = texts("", " ", "\n", "x" * 100_000)


def _console(name: str, words: str, good: str, bad: dict[str | int, object], **more: object) -> Command:
    module = "firmware_bridge.bridge" if name == "edge-bridge" else COMMANDS[name][0]
    return Command(f"{name} {words}".strip(), module, good, bad, **more)  # type: ignore[arg-type]


TABLE: Final = (
    _console(
        "edge-bridge", "", f"--robot {ROBOT}",
        {"--robot": toml_files, "--json": outputs, "--domain": numbers("-1", "233", "1.5"), "--latch": texts("",
         "/dev/null/x", "/nope/x", "x" * 300),
         "--socket": texts("", "/", "x" * 200, "/dev/null/x"), "--runner-group": texts("nope", "\x1b[2J")},
    ),
    _console(
        "edge-bridge", "status", f"status --robot {ROBOT} --socket {{folder}}/none.sock",
        {0: choices, "--robot": toml_files, "--json": outputs, "--socket": directories},
    ),
    _console(
        "edge-run", "", f"--artifacts {{artifacts}} --robot {ROBOT} --instruction go --socket {{folder}}/none.sock",
        {"--artifacts": directories, "--robot": toml_files, "--instruction": instructions, "--mode": choices,
         "--duration": seconds, "--release-delay": numbers("-1", "1e9"), "--trust": other_files(".pub"),
         "--record": outputs, "--json": outputs, "--decoding": choices, "--recovery": choices,
         "--domain": numbers("-1", "233")},
    ),
    _console(
        "edge-run", "delays",
         f"--artifacts {{artifacts}} --robot {ROBOT} --instruction go --socket {{folder}}/none.sock",
        {"--release-delay": json_files},
    ),
    _console(
        "edge-say", "", "walk --to {folder}/none.sock",
        {0: instructions, "--to": directories}, says=("instruction",),
    ),
    _console("edge-say", "stop", "stop --to {folder}/none.sock --socket {folder}/none.sock",
        {"--to": directories, "--socket": directories}, notes=3),
    _console(
        "edge-install", "engines", "engines --artifacts {artifacts}",
        {0: choices, "--artifacts": directories, "--json": outputs},
        quick="engines --artifacts {artifacts} --engines {folder}/engines", quick_notes=1,
    ),
    _console(
        "edge-install", "units",
        f"units --artifacts {{artifacts}} --robot {ROBOT} --instruction go --arm-at-start --out {{folder}}/units",
        {"--artifacts": directories, "--robot": toml_files, "--instruction": instructions, "--json": outputs,
         "--out": output_directories, "--target": texts("nope", "\x1b[2J"), "--trust": other_files(".pub"),
         "--network": texts("", "nope", "1.2.3.4/99", "a\nb"),
         "--bridge-user": texts("", "a b", "root\n", "-x", "x" * 300)},
        says=("edge-export --out",),
    ),
    _console("edge-install", "units file",
         f"units --artifacts {{artifacts}} --robot {ROBOT} --instruction-file x --arm-at-start --out {{folder}}/units",
        {"--instruction-file": other_files(
            ".txt", "escape-key", "json-null", "json-text", "nan-json", "nan-toml", "wrong-types", "zip")}),
    _console(
        "edge-install", "dds", "dds --dry-run --prefix {folder}/prefix",
        {"--archive": texts("", "/nope", "/dev", "/dev/zero", "/dev/null/x", "x" * 300)},
    ),
    _console(
        "edge-install", "board",
         "board --wheel {folder}/x.whl --artifacts {artifacts} --home {folder}/home --dry-run",
        {"--wheel": other_files(".whl"), "--artifacts": unreadable_directories, "--keep": counts,
         "--wheels": texts("/nope", "/dev/null", "/dev/null/x"),
         "--extras": texts("a;b", "x y", "\x1b[2J"), "--constraints": texts("", "/nope", "/dev", "/dev/zero",
         "x" * 300)},
    ),
    _console("edge-install", "boot", "boot --dry-run",
        {"--watchdog": numbers("-1", "0", "121"), "--power-mode": choices}),
    _console("edge-install", "rollback", "rollback --home {folder}/home --dry-run", {"--to": counts,
         "--home": directories}),
    _console("edge-install", "releases", "releases --home {folder}/home", {"--json": outputs},
        quick="releases --home {folder}/home", quick_notes=1),
    _console(
        "edge-doctor", "", "--ticks 0",
        {"--json": outputs, "--ticks": counts, "--user": texts("nope", "\x1b[2J"), "--domain": numbers("1.5")},
        quick="--ticks 0", notes=200,
    ),
    _console(
        "edge-replay", "", "{folder}/none.mcap --artifacts {artifacts}",
        {0: other_files(".mcap"), "--json": outputs, "--from": numbers("-1"),
         "--to": texts("-1", "0", "nan", "abc", "", "0x10", "1,5", "--"),
         "--tolerance-cm": numbers("-1"), "--tolerance-deg": numbers("-1"), "--tolerance-command": numbers("-1")},
    ),
    _console(
        "edge-calib", "odometry", f"odometry {{folder}}/none.mcap --robot {ROBOT}",
        {0: choices, 1: other_files(".mcap"), "--json": outputs, "--out": outputs, "--robot": toml_files},
    ),
    _console(
        "edge-calib", "latency", "latency --log {folder}/none.json --out {folder}/profile.json",
        {"--log": json_files, "--out": outputs, "--json": outputs, "--scale-to-mean": seconds, "--mode": choices,
         "--generations": numbers("-1", "0", "1.5"), "--seconds": seconds},
    ),
    _console(
        "edge-calib", "power", "power --artifacts {artifacts} --out {folder}/power.toml",
        {"--artifacts": directories, "--out": outputs, "--json": outputs, "--seconds": seconds,
         "--rounds": numbers("-1", "0", "1.5"), "--meter": choices},
    ),
    _console(
        "edge-export", "", "--dry-run",
        {"--target": toml_files, "--model": json_files, "--json": outputs,
         "--set": texts("", "=", "a", "a=b", "power.mode", "model.=1", "model.action.layers=nan",
         "model.action.layers=-1",
                        "model.action.layers=1e400", "model.action.layers=" + "9" * 5000, "power.mode=\x1b[2J",
                        "model.action.layers=" + "[" * 90_000, "runtime.tick_period_ms=nan"),
         "--random-weights": numbers("-1", "1.5"), "--cache-gb": numbers("-1", "0")},
        quick="--dry-run", quick_notes=9,
    ),
    _console(
        "edge-export", "build", "--out {folder}/exported --no-cache",
        {"--checkpoint": other_files(".safetensors"), "--calibration": directories, "--out": output_directories,
         "--json": outputs,
         "--save-weights": outputs, "--cache-gb": numbers("-1", "0")}, notes=3,
    ),
    _console("edge-export", "calibration", "--out {folder}/exported --no-cache",
         {"--calibration": texts("folder:", "video:", "folder:/nope", "video:/nope", "folder:/dev", "video:/dev",
         "folder:/dev/zero", "video:/dev/zero", "video:/dev/null", "video:/proc/self/mem", "video:a\x1b[2J\n")},
         notes=3),
    _console("edge-export", "checkpoint folder", "--out {folder}/exported --no-cache",
         {"--checkpoint": directories}, notes=3),
    _console("edge-export", "checkpoint ckpt", "--out {folder}/exported --no-cache",
         {"--checkpoint": other_files(".ckpt")}, notes=3),
    _console("edge-export", "verify", "verify {artifacts}", {1: directories, "--json": outputs,
         "--checkpoint": other_files(".pt")}, notes=3),
    _console(
        "edge-hil", "", "--robot go2 --scene corridor --protocol unitree --duration 0.2 --camera none",
        {"--robot": choices, "--scene": toml_files, "--protocol": choices, "--start": texts("", "1", "nan,1,2",
         "1e9,0,0", "a,b,c"),
         "--people": numbers("-1", "1.5", "1000000"), "--seed": numbers("-1", "1.5"), "--duration": seconds,
         "--domain": numbers("-1", "233"), "--interface": texts("nope0", "\x1b[2J", "x" * 300, "a\nb"),
         "--camera": texts("", "0x0", "nanx1", "99999x99999", "-1x-1"), "--odometry-noise": choices,
         "--pose-hz": numbers("0", "-1"), "--trace": outputs, "--json": outputs, "--link": texts("x"),
         "--faults": texts("/dev/null/x", "x" * 200, "/nope/x")},
    ),
    _console(
        "edge-hil", "can", "--robot carter --scene corridor --protocol can --duration 0.2 --camera none",
        {"--link": texts("", "nope", "serial", "nope:x", "serial:/dev/null/x", "serial:x,drop=nan", "serial:x,drop=2",
                         "serial:x,camera=99999999", "serial:x,nope=1", "serial:x,drop=\x1b[2J",
                         "socketcan:nope0", "udp_multicast:1.2.3.4",
                         "serial:x,babble_hz=-1", "serial:x,babble_hz=1e400", "serial:x,delay_s=inf")},
    ),
    _console(
        "edge-hil", "mavlink", "--robot carter --scene corridor --protocol mavlink --duration 0.2 --camera none",
        {"--link": texts("", "nope", "udp", "udp:x", "udp:127.0.0.1:0x", "udp:127.0.0.1:99999",
         "udp:nope.invalid:1", "udp:127.0.0.1:14999,to=x",
                         "udp:127.0.0.1:14999,key=/nope", "udp:127.0.0.1:14999,key=/dev/zero",
                         "udp:127.0.0.1:14999,loss_percent=nan",
                         "udp:127.0.0.1:14999,loss_percent=101", "udp:127.0.0.1:14999,delay_ms=-1",
                         "udp:127.0.0.1:14999,system=999")},
    ),
    _console(
        "edge-bench", "", "--suite dynanav --policy expert",
        {"--suite": toml_files, "--episodes": texts("nope-*", "\x1b[2J", "["), "--clock": choices, "--robot": choices,
         "--policy": texts("", "nope", "artifacts:", "artifacts:/nope", "external:", "external:x",
         "external:1.2.3.4:0", "external:1.2.3.4:99999",
                           "point-goal-net:/nope", "point-goal-net:/dev/zero", "point-goal-net:/dev/null",
                           "expert:x", "\x1b[2J", "a\nb"),
         "--mode": choices, "--drift": choices, "--variant": texts("nope"), "--wording": numbers("-1", "99999"),
         "--wordings": choices,
         "--swap-instructions": numbers("-1", "1.5"), "--turn-starts": numbers("-1", "1.5"),
         "--decoding": choices, "--recovery": choices,
         "--camera": texts("", "0x0", "nanx1", "99999x99999", "1"), "--external-timeout": numbers("-1", "0"),
         "--jobs": numbers("-1", "0", "1000000"), "--first": numbers("-1", "0", "1.5"),
         "--cluster": texts("", "nope", "nope:1", ":1", "127.0.0.1:1", "127.0.0.1:99999", "127.0.0.1:-1",
         "\x1b[2J:1"),
         "--json": outputs, "--out": output_directories, "--video": choices}, says=("address",),
    ),
    _console("edge-bench", "latency", "--suite dynanav --policy artifacts:{artifacts}",
        {"--latency": numbers("-1", "1e9", "profile:", "profile:/nope", "profile:/dev/zero")}),
    _console("edge-bench", "compare", "compare {folder}/a {folder}/b", {1: directories, "--json": outputs}),
    _console("edge-bench", "report", "report {folder}/a", {1: directories}),
    _console("edge-bench", "validate", "validate", {"--suite": toml_files, "--json": outputs}),
    _console(
        "edge-soak", "", "--artifacts {artifacts} --duration 1m --out {folder}/soak",
        {"--artifacts": directories, "--duration": numbers("-1", "0", "1s", "1y"), "--faults": toml_files,
         "--budget": toml_files,
         "--scene": toml_files, "--people": numbers("-1", "501", "9" * 20),
         "--leg": numbers("-1", "0", "2d"), "--mode": choices,
         "--seed": numbers("-1", "9" * 20),
         "--release-delay": numbers("-1"), "--odometry-noise": choices, "--speed-limit": numbers("-1", "0", "99"),
         "--robot": choices, "--domain": numbers("-1", "233"), "--json": outputs, "--out": output_directories},
    ),
    _console(
        "edge-train", "", "sft --dry-run",
        {0: choices, "--recipe": toml_files, "--preset": choices, "--variant": choices, "--json": outputs,
         "--set": texts("", "=", "a", "a=b", "sft.epochs=nan", "sft.epochs=-1", "sft.epochs=1e400",
         "sft.epochs=" + "9" * 5000,
                        "sft.epochs=" + "[" * 100_000, "sft.nope=1", "model.action.layers=-1", "\x1b[2J=1",
                        "seed=-1"),
         "--delay-profile": json_files},
        quick="sft --dry-run", quick_notes=30,
    ),
    _console(
        "edge-train", "run", "sft --out {folder}/run",
        {"--out": output_directories, "--drives": directories, "--from": directories,
         "--checkpoint": other_files(".safetensors"),
         "--device": texts("", "nope", "cuda:x", "cpu:1", "\x1b[2J"), "--after": texts("nope"),
         "--json": outputs}, notes=2,
    ),
    _console("edge-train", "card", "card --out {folder}/run", {"--out": directories, "--scores": json_files,
         "--ship": output_directories}, says=("train first", "folder of a run")),
)  # fmt: skip
"""One row for each console script and subcommand."""

TOOLS: Final = (
    Command("edge.signature keygen", "edge.signature", "keygen --key {folder}/new.pem", {0: choices,
         "--key": outputs}),
    Command("edge.signature sign", "edge.signature", "sign {artifacts} --key {folder}/none.pem --release 1",
        {1: directories, "--key": other_files(".pem"), "--release": numbers("-1", "0", "1.5")}),
    Command("edge.signature verify", "edge.signature", "verify {artifacts} --trust {folder}/release.pem.pub",
        {1: directories, "--trust": other_files(".pub")}),
    Command("tools.dependencies sbom", "tools.dependencies.__main__", "sbom --out {folder}/sbom.json",
        {0: choices, "--out": outputs, "--extras": texts("nope", "cpu,nope", "\x1b[2J")}, notes=1),
    Command("tools.demo", "tools.demo", "--out {folder}/demo --artifacts {artifacts}",
        {"--out": output_directories, "--artifacts": texts("/dev/null", "/dev/zero", "/tmp"),
         "--duration": seconds, "--seed": numbers("-1"), "--people": numbers("-1"),
         "--robot": choices, "--domain": numbers("-1", "233"), "--json": outputs}),
    Command("tools.faults", "tools.faults.__main__", "--artifacts {artifacts} --out {folder}/faults",
        {"--artifacts": directories, "--out": output_directories, "--rows": texts("nope"), "--robot": choices,
         "--json": outputs,
         "--domain": numbers("-1", "233")}),
    Command("tools.report.demo_report", "tools.report.demo_report", "{folder}/demo", {0: directories,
         "--json": outputs}),
    Command("tools.train.importers", "tools.train.importers.__main__",
         "scand {folder}/recordings --out {folder}/data",
        {0: choices, 1: directories, "--out": output_directories, "--json": outputs}),
    Command("tools.train.point_goal_export", "tools.train.point_goal_export",
         "{folder}/x.safetensors --out {folder}/x.onnx",
        {0: other_files(".safetensors"), "--out": outputs}, says=("encoder weights",)),
    Command("tools.findings", "tools.findings.__main__", "--artifacts {folder} --dry-run --out {folder}/findings",
        {"--artifacts": texts("/nope", "/dev/null", "/dev/null/x"), "--rows": texts("nope", "\x1b[2J"),
         "--suite": toml_files,
         "--latency": numbers("-1"), "--jobs": numbers("-1", "0"), "--json": outputs}),
    Command("tools.findings.split", "tools.findings.split", "--artifacts {artifacts} --out {folder}/split",
        {"--artifacts": directories, "--out": output_directories, "--variants": texts("nope", "\x1b[2J"),
         "--episodes": numbers("-1", "0", "1.5"), "--latency": numbers("-1", "0"), "--jobs": numbers("-1", "0"),
         "--json": outputs}),
    Command("tools.findings.lost", "tools.findings.lost", "--split {folder}/no-split",
        {"--split": directories, "--variant": choices, "--json": outputs}, says=("no-split",)),
    Command("tools.findings.models", "tools.findings.models", "--run {folder}/no-run --out {folder}/models",
        {"--run": directories, "--ablations": directories, "--out": output_directories},
        says=("no run of edge-train",)),
    Command("tools.board", "tools.board.__main__",
         "--root /dev/null/root --artifacts {artifacts} --flight {folder}/x.mcap --out {folder}/board",
        {"--flight": other_files(".mcap"), "--artifacts": directories, "--out": output_directories,
         "--replay-to": seconds, "--domain": numbers("-1", "233")}),
)  # fmt: skip
"""The documented programs that have no console script."""
