"""Configuration of links and their impairments, read from a TOML file and checked."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Final

from sim_hil.network.impairment import PERFECT, Impairment

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

KINDS: Final = {
    "udp": "datagrams to `left` (HOST:PORT) are forwarded to `right` (HOST:PORT), answers back",
    "serial": "two pseudo terminals at the paths `left` and `right`; each write is a packet",
    "can-serial": "the same, and a packet is a frame of python-can's serial interface",
    "frames": "the network interfaces `left` and `right` form one cable: Ethernet frames of any protocol, also DDS",
}


class NetworkError(ValueError):
    """An invalid configuration; one line: what, expected, found."""


@dataclass(frozen=True)
class LinkConfig:
    """One link; `there`: impairment from left to right, `back`: from right to left."""

    name: str
    kind: str
    left: str
    right: str
    there: Impairment = PERFECT
    back: Impairment = PERFECT

    def __post_init__(self) -> None:
        if not isinstance(self.kind, str) or self.kind not in KINDS:
            raise NetworkError(f"link {self.name!r}: kind: expected one of {', '.join(KINDS)}, found {self.kind!r}")
        for side in ("left", "right"):
            if not getattr(self, side) or not isinstance(getattr(self, side), str):
                raise NetworkError(f"link {self.name!r}: {side}: expected a text, found {getattr(self, side)!r}")
            if self.kind == "udp":
                parse_address(getattr(self, side))


@dataclass(frozen=True)
class NetworkConfig:
    """All links, and the seed of their random impairments."""

    links: tuple[LinkConfig, ...]
    seed: int = 0

    def __post_init__(self) -> None:
        names = [link.name for link in self.links]
        if not names or len(set(names)) != len(names):
            raise NetworkError(f"links: expected at least one, with different names, found {names}")
        if not isinstance(self.seed, int) or self.seed < 0:
            raise NetworkError(f"seed: expected 0 or more, found {self.seed!r}")


def parse_address(text: str) -> tuple[str, int]:
    """Parse HOST:PORT. Raises NetworkError."""
    host, _, port = text.rpartition(":")
    if not (host and port.isdecimal() and 0 <= int(port) < 65536):
        raise NetworkError(f"expected HOST:PORT such as 127.0.0.1:14550, found {text!r}")
    return host, int(port)


def load_network(path: Path) -> NetworkConfig:
    """Read a configuration file. Raises NetworkError."""
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise NetworkError(f"{path}: expected a readable file of links, {error.strerror}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise NetworkError(f"{path}: expected TOML: {error}") from error
    try:
        return parse_network(table)
    except NetworkError as error:
        raise NetworkError(f"{path}: {error}") from error


def parse_network(table: Mapping[str, Any]) -> NetworkConfig:
    """Parse a file's content; a link's `impairment` applies to both directions, `there` and `back` to one."""
    _known("the file", table, ("seed", "links"))
    links = table.get("links", [])
    if not isinstance(links, list) or not all(isinstance(link, dict) for link in links):
        raise NetworkError(f"links: expected [[links]] tables, found {links!r}")
    return NetworkConfig(tuple(_link(link) for link in links), table.get("seed", 0))


def _link(table: Mapping[str, Any]) -> LinkConfig:
    name = table.get("name")
    if not isinstance(name, str) or not name:
        raise NetworkError(f"links.name: expected a text, found {name!r}")
    _known(f"link {name!r}", table, ("name", "kind", "left", "right", "impairment", "there", "back"))
    both = table.get("impairment", {})
    directions = {}
    for way in ("there", "back"):
        own = table.get(way, {})
        if not isinstance(both, dict) or not isinstance(own, dict):
            raise NetworkError(f"link {name!r}: {way}: expected a table, found {own!r}")
        directions[way] = parse_impairment(f"link {name!r}: {way}", {**both, **own})
    kind, left, right = (table.get(key, "") for key in ("kind", "left", "right"))
    return LinkConfig(name, kind, left, right, **directions)


def parse_impairment(where: str, table: Mapping[str, Any]) -> Impairment:
    """Parse one direction's impairment. Raises NetworkError that begins with `where`."""
    _known(where, table, tuple(field.name for field in fields(Impairment)))
    values = dict(table)
    if "partitions" in values:
        values["partitions"] = _partitions(where, values["partitions"])
    try:
        return Impairment(**values)
    except (ValueError, TypeError) as error:
        raise NetworkError(f"{where}: {error}") from error


def _partitions(where: str, value: object) -> tuple[tuple[float, float], ...]:
    pairs: list[Any] = value if isinstance(value, list) else [None]
    for pair in pairs:
        numbers = isinstance(pair, list) and all(isinstance(v, (int, float)) and not isinstance(v, bool) for v in pair)
        if not numbers or len(pair) != 2:
            raise NetworkError(f"{where}: partitions: expected [[from, to], ...] in seconds, found {value!r}")
    return tuple((float(begin), float(end)) for begin, end in pairs)


def _known(where: str, table: Mapping[str, object], keys: tuple[str, ...]) -> None:
    for key in table:
        if key not in keys:
            raise NetworkError(f"{where}: expected {', '.join(keys)}, found {key!r}")
