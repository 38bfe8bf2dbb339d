"""`edge-install dds`: a Cyclone DDS binding that works on this board, from packages or from source.

On x86-64 a wheel is enough. On arm64 there is none: the binding 0.10.5 is compiled against a C library 0.10.x, which
comes from packages (Debian 12) or from source (Ubuntu 22.04, whose packages have no 0.10). Every download has a pinned
hash. Downloads and builds are kept, so a second call continues; on a board that has a binding a call does nothing.
Source: protocol facts, section 1.
"""

from __future__ import annotations

import argparse
import errno
import hashlib
import os
import platform
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import urllib.error
import urllib.request
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from edge.core.cli import EXIT_BAD_INPUT, EXIT_CHECK_FAILED, EXIT_DONE

WHEEL: Final = "cyclonedds==11.0.1"
BINDING: Final = "cyclonedds==0.10.5"
BINDING_SHA256: Final = "63fc4d6fdb2fd35181c40f4e90757149f2def5f570ef19fb71edc4f568755f8a"  # PyPI's source archive
LIBRARY_VERSION: Final = "0.10.2"  # the version in the robot
LIBRARY_URL: Final = f"https://deb.debian.org/debian/pool/main/c/cyclonedds/cyclonedds_{LIBRARY_VERSION}.orig.tar.gz"
LIBRARY_SHA256: Final = "ac59ee08975cd25a1fb414ddeb0183fb8636b12d49cea80373013bea59465b43"  # Debian's Sources index
PACKAGES: Final = ("cyclonedds-dev", "cyclonedds-tools", "python3-dev", "gcc", "libc6-dev")
BUILD_PACKAGES: Final = ("cmake", "make", "gcc", "libc6-dev", "python3-dev")
# The binding loads the C library twice, by its own path and by the linker's: two different ones cannot make a topic.
_CHECK: Final = """
import importlib.metadata, pathlib, cyclonedds.domain
maps = pathlib.Path("/proc/self/maps").read_text().splitlines()
libraries = sorted({line.split()[-1] for line in maps if "libddsc" in line})
if len(libraries) > 1:
    raise SystemExit(f"two C libraries are loaded, {' and '.join(libraries)}: remove the package of the system's one")
print(importlib.metadata.version("cyclonedds"))
"""
_CHUNK_BYTES: Final = 1 << 20

Run = Callable[[Sequence[str], Mapping[str, str]], tuple[int, str]]
Say = Callable[[str], None]


class BindingError(RuntimeError):
    """The binding cannot be installed; one line for the operator."""


@dataclass(frozen=True)
class System:
    """What decides how the binding is installed; a test gives another."""

    python: str
    machine: str
    roots: tuple[Path, ...]  # where a C library may be: usr, usr/local
    multiarch: str  # aarch64-linux-gnu
    python_header: Path
    tools: Mapping[str, str | None]  # program -> path

    @classmethod
    def here(cls) -> System:
        """Return this machine."""
        tools = ("gcc", "cmake", "make")
        return cls(
            python=sys.executable,
            machine=platform.machine(),
            roots=(Path("/usr"), Path("/usr/local")),
            multiarch=str(sysconfig.get_config_var("MULTIARCH") or ""),
            python_header=Path(sysconfig.get_path("include")) / "Python.h",
            tools={name: shutil.which(name) for name in tools},
        )


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `edge-install dds`."""
    parser.add_argument(
        "--prefix", type=Path, default=Path(sys.prefix) / "cyclonedds", metavar="DIR",
        help="folder for the C library or links to it; must stay (default: cyclonedds in this Python environment)",
    )  # fmt: skip
    parser.add_argument("--from-source", action="store_true", help="build the C library even where packages have it")
    parser.add_argument(
        "--archive", type=Path, metavar="FILE", help=f"source archive of the C library {LIBRARY_VERSION}, no download"
    )
    parser.add_argument("--dry-run", action="store_true", help="print the steps only")


def run(args: argparse.Namespace, say: Say, system: System | None = None, command: Run | None = None) -> int:
    """Install the binding where none works; returns the exit code."""
    try:
        return _install(args, say, system or System.here(), command or _run_logged)
    except BindingError as error:
        say(str(error))
        return EXIT_CHECK_FAILED
    except OSError as error:
        say(f"{error.filename or args.prefix}: {error.strerror or error}")
        return EXIT_BAD_INPUT


def _install(args: argparse.Namespace, say: Say, system: System, command: Run) -> int:
    if args.archive is not None and not args.archive.is_file():
        raise FileNotFoundError(errno.ENOENT, "expected a source archive, found no file", str(args.archive))
    code, output = command([system.python, "-c", _CHECK], {})
    if code == 0:
        say(f"cyclonedds {output.strip()} works; nothing to do")
        return EXIT_DONE
    prefix = args.prefix.absolute()
    pip = [system.python, "-m", "pip", "install", "--disable-pip-version-check"]
    if system.machine == "x86_64" and not args.from_source:
        steps = [Step(f"install the wheel {WHEEL}", [*pip, "--only-binary", "cyclonedds", WHEEL], {})]
    else:
        steps = _build_steps(args, system, prefix, pip)
    for number, step in enumerate(steps, 1):
        say(f"step {number} of {len(steps)}: {step.text}")
        if not args.dry_run:
            step.run(command, prefix)
    if args.dry_run:
        say("nothing was changed (--dry-run)")
        return EXIT_DONE
    code, output = command([system.python, "-c", _CHECK], {})
    if code != 0:
        raise BindingError(f"the binding is installed, but does not work: {_last_line(output)}")
    say(f"cyclonedds {output.strip()} works")
    return EXIT_DONE


@dataclass(frozen=True)
class Step:
    """One command, or one action on files, of the installation."""

    text: str
    words: Sequence[str]
    environment: Mapping[str, str]
    action: Callable[[], None] | None = None

    def run(self, command: Run, prefix: Path) -> None:
        """Do it. Raises BindingError with the compiler's or pip's own last line."""
        if self.action is not None:
            self.action()
            return
        code, output = command(self.words, self.environment)
        if code != 0:
            log = prefix.parent / f"{prefix.name}.log"
            log.write_text(output)
            raise BindingError(f"cannot {self.text}: {explained(output)}; the whole output is in {log}")


def explained(output: str) -> str:
    """Return what to do about a failed build, or the build's own last error line."""
    known = {
        "Python.h: No such file": "Python's headers are missing: sudo apt-get install python3-dev",
        "No space left on device": "the disk is full",
        "command 'gcc' failed: No such file": "there is no compiler: sudo apt-get install gcc libc6-dev",
        "Could not locate cyclonedds": "the C library is not in the prefix: remove the prefix and run this again",
        "THESE PACKAGES DO NOT MATCH THE HASHES": "the downloaded archive is not the pinned one: check the index",
        "Temporary failure in name resolution": "no network: run this again with a network, it continues",
    }
    for sign, advice in known.items():
        if sign in output:
            return advice
    errors = [line.strip() for line in output.splitlines() if "error" in line.lower()]
    return errors[-1] if errors else _last_line(output)


def _build_steps(args: argparse.Namespace, system: System, prefix: Path, pip: list[str]) -> list[Step]:
    """Return the steps of a build. Raises BindingError where a package is missing."""
    steps = []
    library = None if args.from_source else _system_library(system)
    if library is not None:
        steps.append(Step(f"link the C library of {library.root} into {prefix}", (), {}, lambda: library.link(prefix)))
    elif not args.from_source and shutil.which("apt-cache") and _has_packaged_library():
        raise BindingError(f"the C library is missing: sudo apt-get install {' '.join(PACKAGES)}; then run this again")
    else:
        missing = [name for name in ("cmake", "make", "gcc") if system.tools.get(name) is None]
        if missing:
            raise BindingError(f"{', '.join(missing)} missing: sudo apt-get install {' '.join(BUILD_PACKAGES)}")
        steps.extend(_library_steps(args.archive, prefix))
    if system.tools.get("gcc") is None:
        raise BindingError("there is no compiler: sudo apt-get install gcc libc6-dev; then run this again")
    if not system.python_header.is_file():
        raise BindingError(f"{system.python_header} is missing: sudo apt-get install python3-dev; then run this again")
    # The compiled part of the binding must find a library that no system folder has.
    environment = {"CYCLONEDDS_HOME": str(prefix), "LDFLAGS": f"-Wl,-rpath,{prefix / 'lib'}"}
    # The source archive's own build script fails with newer versions of setuptools.
    tools = Step("install the build tools of the binding", [*pip, "setuptools<70", "wheel"], {})
    pinned = prefix.parent / f"{prefix.name}.requirement.txt"

    def pin() -> None:
        pinned.write_text(f"{BINDING} --hash=sha256:{BINDING_SHA256}\n")

    # pip 23.1 and newer keep what they have compiled: that of an earlier release leads to that release's own C library.
    words = [*pip, "--no-cache-dir", "--no-build-isolation", "--no-binary", "cyclonedds", "--no-deps"]
    words += ["-r", str(pinned)]
    steps += [
        tools,
        Step(f"pin {BINDING} to its hash", (), {}, pin),
        Step(f"compile {BINDING}", words, environment),
        Step("install what the binding needs", [*pip, "rich-click"], {}),
    ]
    return steps


@dataclass(frozen=True)
class Library:
    """A C library 0.10 as packages install it."""

    root: Path
    libraries: Path
    idlc: Path

    def link(self, prefix: Path) -> None:
        """Make `prefix` the folder that the binding's build script expects, of links."""
        for folder in ("bin", "lib"):
            (prefix / folder).mkdir(parents=True, exist_ok=True)
        links = {
            prefix / "bin/idlc": self.idlc,
            prefix / "lib/libddsc.so": self.libraries / "libddsc.so",
            prefix / "lib/libcycloneddsidl.so": self.libraries / "libcycloneddsidl.so",
            prefix / "include": self.root / "include",
        }
        for link, target in links.items():
            link.unlink(missing_ok=True)
            link.symlink_to(target)


def _system_library(system: System) -> Library | None:
    """Return the first complete C library 0.10 of the system."""
    for root in system.roots:
        for folder in (root / "lib" / system.multiarch, root / "lib"):
            names = ("libddsc.so", "libcycloneddsidl.so")
            idlc = root / "bin/idlc"
            files = [*(folder / name for name in names), idlc, root / "include/dds/dds.h"]
            if all(file.exists() for file in files) and ".so.0.10." in files[0].resolve().name:
                return Library(root, folder, idlc)
    return None


def _has_packaged_library() -> bool:
    """Return whether this distribution's packages have the C library 0.10."""
    done = subprocess.run(["apt-cache", "policy", "cyclonedds-dev"], capture_output=True, text=True, check=False)
    return "Candidate: 0.10" in done.stdout


def _library_steps(archive: Path | None, prefix: Path) -> list[Step]:
    """Return the steps that build the C library from source into `prefix`."""
    if (prefix / "lib/libddsc.so").exists() and (prefix / "bin/idlc").exists():
        return []
    work = prefix.parent / f"{prefix.name}.build"
    source = archive or work / LIBRARY_URL.rsplit("/", 1)[1]
    options = ["-DCMAKE_BUILD_TYPE=Release", f"-DCMAKE_INSTALL_PREFIX={prefix}", "-DCMAKE_INSTALL_LIBDIR=lib"]
    options += ["-DENABLE_SSL=OFF", "-DENABLE_SHM=OFF", "-DBUILD_EXAMPLES=OFF", "-DBUILD_DDSPERF=OFF"]
    jobs = str(os.cpu_count() or 1)
    return [
        Step(f"get the source of the C library {LIBRARY_VERSION}", (), {}, lambda: fetch(source, archive is not None)),
        Step("unpack it", (), {}, lambda: _unpack(source, work / "source")),
        Step("configure it", ["cmake", "-S", str(work / "source"), "-B", str(work / "out"), *options], {}),
        Step("compile it", ["cmake", "--build", str(work / "out"), "--parallel", jobs], {}),
        Step(f"install it into {prefix}", ["cmake", "--install", str(work / "out")], {}),
    ]


def fetch(path: Path, is_given: bool, url: str = LIBRARY_URL, sha256: str = LIBRARY_SHA256) -> None:
    """Download `url` to `path`, continuing an earlier part, and check its hash. Raises BindingError."""
    if not is_given and not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        part = path.with_name(f"{path.name}.part")
        offset = part.stat().st_size if part.exists() else 0
        request = urllib.request.Request(url, headers={"Range": f"bytes={offset}-"} if offset else {})
        try:
            with urllib.request.urlopen(request, timeout=60) as answer:
                mode = "ab" if offset and answer.status == 206 else "wb"
                with part.open(mode) as file:
                    shutil.copyfileobj(answer, file, _CHUNK_BYTES)
        except (urllib.error.URLError, TimeoutError, ConnectionError) as error:
            raise BindingError(
                f"cannot download {url}: {error}; run this again to continue, or give --archive"
            ) from error
        part.replace(path)
    found = _digest(path)
    if found != sha256:
        if not is_given:
            path.unlink()
        raise BindingError(f"{path}: expected SHA-256 {sha256}, found {found}; nothing was built from it")


def _digest(path: Path) -> str:
    """Return the SHA-256 of a file."""
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(_CHUNK_BYTES):
            digest.update(block)
    return digest.hexdigest()


def _unpack(archive: Path, target: Path) -> None:
    """Unpack the archive's one top folder as `target`, whole or not at all."""
    if target.exists():
        return
    beside = target.with_name(f"{target.name}.part")
    shutil.rmtree(beside, ignore_errors=True)
    with tarfile.open(archive) as tar:
        tar.extractall(beside)  # its hash has been checked
    (top,) = beside.iterdir()
    top.replace(target)
    beside.rmdir()


def _run_logged(words: Sequence[str], environment: Mapping[str, str]) -> tuple[int, str]:
    """Run a command; returns its exit code and everything it printed."""
    done = subprocess.run(
        list(words), env={**os.environ, **environment}, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        errors="replace", check=False,
    )  # fmt: skip
    return done.returncode, done.stdout


def _last_line(output: str) -> str:
    lines = [line.strip() for line in output.splitlines() if line.strip()]
    return lines[-1] if lines else "no output"
