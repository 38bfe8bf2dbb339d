"""A Debian 12 arm64 root folder, made once and kept: debootstrap, with qemu-user behind the kernel's binfmt_misc."""

from __future__ import annotations

import contextlib
import os
import shutil
import subprocess
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

SUITE: Final = "bookworm"
MIRROR: Final = "http://deb.debian.org/debian"
# What docs/robot.md has the user install: Python, and the compiler and C library for the DDS binding.
PACKAGES: Final = ("python3", "python3-venv", "python3-dev", "gcc", "libc6-dev", "ca-certificates", "cyclonedds-dev", "cyclonedds-tools")  # fmt: skip # noqa: E501
TOOLS: Final = {"debootstrap": "debootstrap", "qemu-aarch64-static": "qemu-user-static"}
BINFMT: Final = Path("/proc/sys/fs/binfmt_misc")
HANDLER: Final = Path("/usr/lib/binfmt.d/qemu-aarch64.conf")
_STAMP: Final = "etc/tic-vla-edge-root"
_ENVIRONMENT: Final = {
    "DEBIAN_FRONTEND": "noninteractive",
    "HOME": "/root",
    "LC_ALL": "C.UTF-8",
    "PATH": "/usr/sbin:/usr/bin:/sbin:/bin",
}


class RootError(RuntimeError):
    """The root cannot be made; one line for the developer."""


def check_host() -> None:
    """Raise RootError where this machine lacks what the emulation needs; register qemu where it is not registered."""
    if os.geteuid() != 0:
        raise RootError("an arm64 root needs root: sudo")
    missing = [package for tool, package in TOOLS.items() if shutil.which(tool) is None]
    if missing:
        raise RootError(f"missing: sudo apt-get install {' '.join(missing)}")
    if not (BINFMT / "register").exists():
        run(["mount", "-t", "binfmt_misc", "none", str(BINFMT)])
    if not (BINFMT / "qemu-aarch64").exists():
        if not HANDLER.exists():
            raise RootError(f"{HANDLER} is missing: sudo apt-get install --reinstall qemu-user-static")
        (BINFMT / "register").write_text(HANDLER.read_text().strip())


def make_root(root: Path) -> bool:
    """Make the root folder, in about 15 minutes; False where it was complete. Raises RootError."""
    check_host()
    if (root / _STAMP).exists():
        return False
    if not (root / "debootstrap").exists() and not (root / "usr/bin/apt-get").exists():
        run(["debootstrap", "--arch=arm64", "--foreign", "--variant=minbase", SUITE, str(root), MIRROR])
    if (root / "debootstrap").exists():
        inside(root, ["/debootstrap/debootstrap", "--second-stage"])
    shutil.copy("/etc/resolv.conf", root / "etc/resolv.conf")
    # A machine behind a proxy or with its own certificates reaches the registries by these files.
    for name in (
        "etc/pip.conf",
        *(f"etc/apt/apt.conf.d/{path.name}" for path in Path("/etc/apt/apt.conf.d").glob("99*")),
    ):
        if Path("/", name).is_file():
            shutil.copy(Path("/", name), root / name)
    with mounted(root):
        inside(root, ["apt-get", "update", "-qq"])
        inside(root, ["apt-get", "install", "-y", "-qq", "--no-install-recommends", *PACKAGES])
    certificates = "etc/ssl/certs/ca-certificates.crt"
    shutil.copy(Path("/", certificates).resolve(), root / certificates)
    (root / _STAMP).write_text(f"{SUITE} arm64\n")
    return True


@contextlib.contextmanager
def mounted(root: Path) -> Iterator[None]:
    """Give the root /proc and /dev while the block runs.

    /sys stays empty: ONNX Runtime would read this machine's processors there and crash. The copy of /dev is a slave:
    its unmounting must not unmount this machine's own /dev/pts.
    """
    mounts = [(["-t", "proc", "proc"], root / "proc"), (["--rbind", "--make-rslave", "/dev"], root / "dev")]
    try:
        for words, target in mounts:
            if not os.path.ismount(target):
                run(["mount", *words, str(target)])
        yield
    finally:
        for _, target in mounts:
            if os.path.ismount(target):
                subprocess.run(["umount", "--lazy", "--recursive", str(target)], check=False)


@dataclass(frozen=True)
class Ended:
    """An ended command of the root."""

    code: int
    output: str
    wall_s: float
    peak_rss_mb: float
    """Largest memory of one of its processes, the emulator's own included, MB."""


def inside(root: Path, words: Sequence[str]) -> str:
    """Run a command in the root and return its output. Raises RootError."""
    return run(["chroot", str(root), *words], _ENVIRONMENT)


def ended(root: Path, words: Sequence[str]) -> Ended:
    """Run a command in the root, whatever its exit code."""
    started_s = time.monotonic()
    with tempfile.TemporaryFile() as file:
        process = subprocess.Popen(
            ["chroot", str(root), *words], env=_ENVIRONMENT, stdin=subprocess.DEVNULL, stdout=file, stderr=file
        )
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = code = os.waitstatus_to_exitcode(status)
        wall_s = round(time.monotonic() - started_s, 1)
        file.seek(0)
        output = file.read().decode(errors="replace")
    return Ended(code, output, wall_s, round(usage.ru_maxrss / 1024, 1))


def run(words: Sequence[str], environment: dict[str, str] | None = None) -> str:
    """Run a command and return its output. Raises RootError with its last line."""
    done = subprocess.run(
        list(words), env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, errors="replace",
        check=False,
    )  # fmt: skip
    if done.returncode != 0:
        lines = done.stdout.strip().splitlines() or ["no output"]
        raise RootError(f"{' '.join(words)}: exit code {done.returncode}: {lines[-1]}")
    return done.stdout
