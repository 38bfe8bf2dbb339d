"""Where a live view listens and whom it lets in: `--live`, `--live-address` and `--live-token` of every command."""

from __future__ import annotations

import argparse
import contextlib
import importlib.util
import os
import re
import secrets
import socket
import stat
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from firmware_bridge.core.config import ConfigError

LOOPBACK: Final = "127.0.0.1"
DEFAULT_PORT: Final = 8765
"""The port at which viewers of robot data look first."""
_TOKEN_BYTES: Final = 16
_TOKEN: Final = re.compile(r"[A-Za-z0-9_-]{22,128}")
_OTHERS: Final = 0o077
_EVERY: Final = {
    "0.0.0.0": (LOOPBACK, socket.AF_INET, "192.0.2.1"),
    "::": ("::1", socket.AF_INET6, "2001:db8::1"),  # IPv6 alone: asyncio listens there with IPV6_V6ONLY
}
"""Addresses that mean every interface: their loopback, family, and an address elsewhere (RFC 5737, RFC 3849)."""


class LiveError(OSError):
    """The live view cannot start; one line."""


@dataclass(frozen=True)
class LiveOptions:
    """Where to listen; port 0 takes a free one; without `token_file` every run has a new token. Raises ValueError."""

    address: str = LOOPBACK
    port: int = DEFAULT_PORT
    token_file: Path | None = None

    def __post_init__(self) -> None:
        if not 0 <= self.port <= 65_535:
            raise ValueError(f"--live {self.port}: expected a port from 0 to 65535")
        if not self.address:
            raise ValueError("--live-address: expected an address, found none")

    def arguments(self) -> list[str]:
        """Return the command line of these options."""
        token = [] if self.token_file is None else ["--live-token", str(self.token_file)]
        return ["--live", str(self.port), "--live-address", self.address, *token]

    def token(self) -> str:
        """Return the file's token, which is written first where there is none, or a new one. Raises LiveError."""
        return secrets.token_urlsafe(_TOKEN_BYTES) if self.token_file is None else kept_token(self.token_file)

    def url(self, port: int, token: str) -> str:
        """Return the page's address for a browser of this machine."""
        shown = _EVERY[self.address][0] if self.address in _EVERY else self.address
        return _url(shown, port, token)

    def url_elsewhere(self, port: int, token: str) -> str | None:
        """Return the page's address for other computers where every interface listens, else None."""
        if self.address not in _EVERY:
            return None
        _, family, elsewhere = _EVERY[self.address]
        return _url(_own_address(family, elsewhere), port, token)


def _url(host: str, port: int, token: str) -> str:
    return f"http://{f'[{host}]' if ':' in host else host}:{port}/?token={token}"


def _own_address(family: socket.AddressFamily, elsewhere: str) -> str:
    """Return this machine's address on the way to `elsewhere`; its name where no network leads there."""
    try:
        with socket.socket(family, socket.SOCK_DGRAM) as probe:
            probe.connect((elsewhere, 9))  # chooses the interface; a datagram socket sends nothing yet
            return str(probe.getsockname()[0])
    except OSError:
        return socket.gethostname()


def kept_token(path: Path) -> str:
    """Return the token in a file that only this user may read; write a new one where there is no file.

    Raises LiveError.
    """
    try:
        with contextlib.suppress(FileExistsError):
            made = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, 0o600)
            with os.fdopen(made, "w", encoding="ascii") as file:
                file.write(secrets.token_urlsafe(_TOKEN_BYTES) + "\n")
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
        with os.fdopen(descriptor, encoding="ascii", errors="replace") as file:
            facts = os.fstat(file.fileno())
            if not stat.S_ISREG(facts.st_mode) or facts.st_uid != os.getuid() or facts.st_mode & _OTHERS:
                raise LiveError(f"--live-token {path}: expected a file of this user that nobody else may read")
            text = file.read(1024).strip()
    except LiveError:
        raise
    except OSError as error:
        raise LiveError(f"--live-token {path}: cannot be used: {error.strerror or error}") from error
    if not _TOKEN.fullmatch(text):
        raise LiveError(f"--live-token {path}: expected 22 to 128 letters, digits, - and _; remove it to get a new one")
    return text


def add_live_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the live view to a command."""
    parser.add_argument(
        "--live",
        nargs="?",
        type=int,
        const=DEFAULT_PORT,
        metavar="PORT",
        help=f"serve a live view to browsers and Foxglove (default port {DEFAULT_PORT}; 0: a free one)",
    )
    parser.add_argument(
        "--live-address",
        default=LOOPBACK,
        metavar="ADDR",
        help="where the live view listens; 0.0.0.0 admits other computers with the token (default: %(default)s)",
    )
    parser.add_argument(
        "--live-token",
        type=Path,
        metavar="FILE",
        help="keep the token in this file, so that an open page finds the next run (default: a new token)",
    )


def live_options(args: argparse.Namespace) -> LiveOptions | None:
    """Return the options of a command line; None without `--live`.

    Raises ConfigError, and ModuleNotFoundError where the extra `live` is missing.
    """
    if args.live is None:
        for flag, given in (("--live-address", args.live_address != LOOPBACK), ("--live-token", args.live_token)):
            if given:
                raise ConfigError(f"{flag}: expected --live beside it")
        return None
    for module in ("aiohttp", "prometheus_client"):  # before anything starts; the view's process imports them
        if importlib.util.find_spec(module) is None:
            raise ModuleNotFoundError(f"No module named {module!r}", name=module)
    try:
        token_file = None if args.live_token is None else args.live_token.absolute()
        return LiveOptions(args.live_address, args.live, token_file)
    except ValueError as error:
        raise ConfigError(str(error)) from error
