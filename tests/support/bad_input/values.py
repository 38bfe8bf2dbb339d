"""Bad values for each kind of argument. Files are made once for all cases."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

DEPTH = 100_000
SPARSE_BYTES = 10 * 10**9
HUGE = "9" * 5000
NUMBER_TEXTS = ("nan", "inf", "-inf", "1e400", "abc", "", "0x10", "1,5", "--", HUGE)
BAD_CONTENT: dict[str, bytes] = {
    "empty": b"",
    "binary": bytes(range(256)) * 4,
    "not-utf8": b'name = "\xff\xfe"\n',
    "nul": b"\0" * 4096,
    "deep-list": b"a = " + b"[" * DEPTH + b"]" * DEPTH,
    "deep-table": b"[" + b"a." * DEPTH + b"a]\nb = 1\n",
    "deep-json": b'{"a":' * DEPTH + b"1" + b"}" * DEPTH,
    "deep-json-list": b"[" * DEPTH + b"]" * DEPTH,
    "nan-toml": b"schema = nan\nformat = nan\nname = inf\nx = -inf\n",
    "nan-json": b'{"schema": NaN, "format": Infinity, "name": -Infinity}',
    "huge-number": b"schema = " + b"9" * 5000 + b"\n",
    "huge-number-json": b'{"schema": ' + b"9" * 5000 + b"}",
    "wrong-types": b'schema = [1, 2]\nname = {a = 1}\nformat = "x"\n',
    "json-null": b"null",
    "json-text": b'"\\ud800\\u0000\\u001b[2J"',
    "escape-key": b'"\\u001b[2Jkey\\n\\n" = 1\n',
    "long-key": b"k" * 1_000_000 + b" = 1\n",
    "zip": b"PK\x03\x04" + b"\0" * 100,
    "pickle": b"\x80\x04\x95" + b"\0" * 100,
    "safetensors-header": (2**63 - 1).to_bytes(8, "little") + b"{}",
    "safetensors-deep": (DEPTH * 6 + 1).to_bytes(8, "little") + b'{"a":' * DEPTH + b"1" + b"}" * DEPTH,
    "mcap-magic": b"\x89MCAP0\r\n" + b"\xff" * 64,
}


@dataclass(frozen=True)
class Bad:
    """A bad value: what makes it bad, its text, and how the command has to be started for it."""

    label: str
    text: str
    unprivileged: bool = False
    small_files: bool = False


def files(folder: Path, suffix: str) -> Iterator[Bad]:
    """Files that cannot be the expected one; `suffix` is the one that the command expects, such as `.toml`."""
    made = folder / f"files{suffix}"
    if not made.exists():
        _make_files(made, suffix)
    for path in sorted(made.iterdir()):
        yield Bad(path.name.removesuffix(suffix), str(path), unprivileged=path.name.startswith("unreadable"))
    yield from _names(made, suffix)
    for device in ("/dev/full", "/dev/zero", "/proc/self/mem"):
        yield Bad(device, device)


def directories(folder: Path) -> Iterator[Bad]:
    """Folders that cannot be the expected one."""
    made = folder / "directories"
    if not made.exists():
        made.mkdir()
        (made / "empty").mkdir()
        (made / "file").write_bytes(b"x")
        (made / "loop").symlink_to(made / "loop")
        (made / "dangling").symlink_to(made / "nothing")
        os.mkfifo(made / "fifo")
        for name, content in (("deep", BAD_CONTENT["deep-json"]), ("binary", BAD_CONTENT["binary"])):
            (made / name).mkdir()
            for file in ("manifest.json", "recipe.toml", "config.json", "result.json", "settings.json"):
                (made / name / file).write_bytes(content)
        (made / "loops").mkdir()
        for file in ("manifest.json", "recipe.toml", "config.json", "result.json", "settings.json"):
            (made / "loops" / file).symlink_to(file)
        (made / "locked").mkdir(mode=0o700)
    for path in sorted(made.iterdir()):
        yield Bad(path.name, str(path), unprivileged=path.name == "locked")
    yield from _names(made, "")
    for device in ("/dev/full", "/dev/null"):
        yield Bad(device, device)


def unreadable_directories(folder: Path) -> Iterator[Bad]:
    """Folders of which a command does not even read the first file."""
    return (bad for bad in directories(folder) if bad.label not in ("binary", "deep"))


def outputs(folder: Path) -> Iterator[Bad]:
    """Files that cannot be written, which a command finds before it works."""
    made = folder / "outputs"
    if not made.exists():
        made.mkdir()
        (made / "directory").mkdir()
        (made / "file").write_bytes(b"x")
        (made / "loop").symlink_to(made / "loop")
        (made / "locked").mkdir(mode=0o555)
        os.mkfifo(made / "fifo")
    yield Bad("directory", str(made / "directory"))
    yield Bad("under-file", str(made / "file" / "result.json"))
    yield Bad("loop", str(made / "loop"))
    yield Bad("read-only-directory", str(made / "locked" / "result.json"), unprivileged=True)
    yield Bad("no-name", "")
    yield Bad("dot", ".")
    yield Bad("long-name", str(made / ("n" * 300)))


def output_directories(folder: Path) -> Iterator[Bad]:
    """Folders that cannot be created or written to."""
    for bad in outputs(folder):
        if bad.label not in ("directory", "dot", "no-name"):
            yield bad
    yield Bad("file", str(folder / "outputs" / "file"))
    yield Bad("locked", str(folder / "outputs" / "locked"), unprivileged=True)


def full_outputs(folder: Path) -> Iterator[Bad]:
    """Files whose disk is full, or that take nothing, which only writing shows."""
    yield Bad("/dev/full", "/dev/full")
    yield Bad("fifo-without-reader", str(folder / "outputs" / "fifo"))
    yield Bad("read-only-disk", "/proc/tic-vla-result.json")
    yield Bad("full-disk", str(folder / "outputs" / "result-of-a-full-disk.json"), small_files=True)


def numbers(*more: str) -> Callable[[Path], Iterator[Bad]]:
    """Texts that are no number in the option's range; `more`: numbers beyond it."""

    def made(_folder: Path) -> Iterator[Bad]:
        for text in (*NUMBER_TEXTS, *more):
            yield Bad(f"number {text[:12]!r}", text)

    return made


def texts(*bad: str) -> Callable[[Path], Iterator[Bad]]:
    """The given texts."""
    return lambda _folder: (Bad(f"text {text[:24]!r}", text) for text in bad)


choices = texts("", "nope", "NOPE\x1b[2J", "a\nb", "é" * 2000)


def toml_files(folder: Path) -> Iterator[Bad]:
    """Files that are no TOML of the expected content."""
    return files(folder, ".toml")


def json_files(folder: Path) -> Iterator[Bad]:
    """Files that are no JSON of the expected content."""
    return files(folder, ".json")


def other_files(suffix: str, *without: str) -> Callable[[Path], Iterator[Bad]]:
    """Files of another kind, named like it; `without`: labels of those that would be right."""
    return lambda folder: (bad for bad in files(folder, suffix) if bad.label not in without)


def _names(made: Path, suffix: str) -> Iterator[Bad]:
    yield Bad("missing", str(made / f"missing{suffix}"))
    yield Bad("under-file", str(made / f"empty{suffix}" / f"x{suffix}") if suffix else str(made / "file" / "x"))
    yield Bad("long-name", str(made / ("n" * 300 + suffix)))
    yield Bad("long-path", "/".join(["d" * 200] * 30) + suffix)
    yield Bad("escape-name", str(made / f"\x1b[2J\nname{suffix}"))
    yield Bad("not-utf8-name", os.fsdecode(os.fsencode(made) + b"/\xff\xfename" + suffix.encode()))


def _make_files(made: Path, suffix: str) -> None:
    made.mkdir()
    for name, content in BAD_CONTENT.items():
        (made / f"{name}{suffix}").write_bytes(content)
    (made / f"directory{suffix}").mkdir()
    (made / f"loop{suffix}").symlink_to(made / f"loop{suffix}")
    (made / f"dangling{suffix}").symlink_to(made / "nothing")
    os.mkfifo(made / f"fifo{suffix}")
    (made / f"unreadable{suffix}").write_bytes(b"x = 1\n")
    (made / f"unreadable{suffix}").chmod(0)
    with (made / f"sparse{suffix}").open("wb") as file:
        file.truncate(SPARSE_BYTES)
