"""Reads the licences of installed packages from their metadata and compares them with the policy."""

from __future__ import annotations

import contextlib
import importlib.metadata
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from firmware_bridge.system.input_file import read_toml

PROJECT: Final = "tic-vla-edge"
POLICY: Final = Path(__file__).with_name("policy.toml")
BASE: Final = "base"
"""Name of the install without extras."""
_WORD: Final = re.compile(r"\(|\)|[^\s()]+")


class LicenceError(ValueError):
    """A licence expression or policy that cannot be read; one line."""


@dataclass(frozen=True)
class Policy:
    """Permitted licences, named exceptions, and how texts of metadata are read."""

    allowed: frozenset[str]
    exceptions: Mapping[str, Mapping[str, Any]]
    packages: Mapping[str, str]
    texts: Mapping[str, str]


@dataclass(frozen=True)
class Package:
    """An installed package that the project needs: its licence (an SPDX expression) and the extras that need it."""

    name: str
    version: str
    licence: str
    homepage: str
    extras: tuple[str, ...]
    needs: tuple[str, ...]
    """Names of the packages that it needs itself."""
    copyrights: tuple[str, ...] = ()


def read_policy(path: Path = POLICY) -> Policy:
    """Read the policy. Raises OSError or ValueError."""
    table = read_toml(path)
    try:
        return Policy(frozenset(table["allowed"]), table["exceptions"], table["packages"], table["texts"])
    except (KeyError, TypeError) as error:
        raise LicenceError(f"{path}: expected allowed, exceptions, packages and texts: {error}") from error


def installed(policy: Policy, project: str = PROJECT) -> tuple[list[Package], list[str]]:
    """Return the installed packages that a project needs with any extra, and the names of those not installed."""
    root = importlib.metadata.distribution(project)
    found: dict[str, set[str]] = {}
    absent: set[str] = set()
    for extra in [BASE, *(root.metadata.get_all("Provides-Extra") or [])]:
        _walk(root, "" if extra == BASE else extra, extra, found, absent, set())
    packages = []
    for name, extras in sorted(found.items()):
        distribution = importlib.metadata.distribution(name)
        needs = {canonicalize_name(each.name) for each in _requirements(distribution, "")}
        packages.append(
            Package(
                name=distribution.metadata["Name"],
                version=distribution.version,
                licence=licence_of(distribution.metadata, policy),
                homepage=_homepage(distribution.metadata),
                extras=tuple(sorted(extras)),
                needs=tuple(sorted(each for each in needs if each in found)),
                copyrights=tuple(_copyrights(distribution)),
            )
        )
    return packages, sorted(absent)


def licence_of(metadata: Any, policy: Policy) -> str:
    """Return a package's licence as an SPDX expression; empty where its metadata does not tell."""
    name = canonicalize_name(metadata["Name"])
    if name in policy.exceptions:
        return str(policy.exceptions[name]["licence"])
    if name in policy.packages:
        return policy.packages[name]
    classifiers = [each.rpartition(" :: ")[2] for each in metadata.get_all("Classifier") or [] if "License ::" in each]
    for text in (metadata.get("License-Expression"), metadata.get("License"), *classifiers):
        if not text:
            continue
        if text in policy.texts:
            return policy.texts[text]
        with contextlib.suppress(LicenceError):  # a text in words, or a whole licence
            is_permitted(text, policy.allowed)
            return str(text)
    return ""


def problems(packages: Sequence[Package], policy: Policy) -> list[str]:
    """Return one line for each package whose licence the policy does not permit where it occurs."""
    lines = []
    for package in packages:
        exception = policy.exceptions.get(canonicalize_name(package.name))
        where = f"{package.name} {package.version}"
        if exception is not None:
            beyond = sorted(set(package.extras) - set(exception["extras"]))
            if beyond:
                places = ", ".join(exception["extras"])
                lines.append(f"{where}: {package.licence} is permitted in {places} only, found in {', '.join(beyond)}")
        elif not package.licence:
            lines.append(f"{where}: its metadata names no licence; read it, then add it to {POLICY.name} [packages]")
        elif not is_permitted(package.licence, policy.allowed):
            lines.append(f"{where}: {package.licence} is not in {POLICY.name} allowed")
    return lines


def is_permitted(expression: str, allowed: frozenset[str]) -> bool:
    """Return whether a choice of an SPDX expression is permitted: all of AND, one of OR. Raises LicenceError."""
    words = _words(expression)
    result, rest = _any_of(words, allowed)
    if rest:
        raise LicenceError(f"{expression!r}: expected an SPDX expression, found {rest[0]!r} too much")
    return result


def _any_of(words: list[str], allowed: frozenset[str]) -> tuple[bool, list[str]]:
    result, words = _all_of(words, allowed)
    while words and words[0] == "OR":
        other, words = _all_of(words[1:], allowed)
        result = result or other
    return result, words


def _all_of(words: list[str], allowed: frozenset[str]) -> tuple[bool, list[str]]:
    result, words = _one(words, allowed)
    while words and words[0] == "AND":
        other, words = _one(words[1:], allowed)
        result = result and other
    return result, words


def _one(words: list[str], allowed: frozenset[str]) -> tuple[bool, list[str]]:
    if not words or words[0] in (")", "AND", "OR", "WITH"):
        raise LicenceError("expected the name of a licence")
    if words[0] == "(":
        result, rest = _any_of(words[1:], allowed)
        if rest[:1] != [")"]:
            raise LicenceError("expected ) in a licence expression")
        return result, rest[1:]
    if words[1:2] == ["WITH"]:
        return f"{words[0]} WITH {''.join(words[2:3])}" in allowed, words[3:]
    return words[0] in allowed, words[1:]


def _words(expression: str) -> list[str]:
    return _WORD.findall(expression)


def _requirements(distribution: importlib.metadata.Distribution, extra: str) -> Iterator[Requirement]:
    for text in distribution.requires or ():
        requirement = Requirement(text)
        if requirement.marker is None or requirement.marker.evaluate({"extra": extra}):
            yield requirement


def _walk(
    distribution: importlib.metadata.Distribution, extra: str, label: str, found: dict[str, set[str]],
    absent: set[str], seen: set[tuple[str, str]],
) -> None:  # fmt: skip
    """Add what a distribution needs with one of its extras, at any depth."""
    for requirement in _requirements(distribution, extra):
        name = canonicalize_name(requirement.name)
        for own in ("", *requirement.extras):
            if (name, own) in seen:
                continue
            seen.add((name, own))
            try:
                needed = importlib.metadata.distribution(name)
            except importlib.metadata.PackageNotFoundError:
                absent.add(name)
                continue
            if name != PROJECT:
                found.setdefault(name, set()).add(label)
            _walk(needed, own, label, found, absent, seen)


def _homepage(metadata: Any) -> str:
    urls = dict(each.split(", ", 1) for each in metadata.get_all("Project-URL") or [] if ", " in each)
    chosen = metadata.get("Home-page") or next(
        (urls[key] for key in ("Homepage", "homepage", "Home", "Repository", "Source") if key in urls), ""
    )
    return str(chosen or next(iter(urls.values()), ""))


def _copyrights(distribution: importlib.metadata.Distribution) -> Iterator[str]:
    """Yield the copyright lines of the licence files that a package ships."""
    seen: set[str] = set()
    for file in distribution.files or ():
        if not re.search(r"\.dist-info/(licen[cs]es/)?(LICEN[CS]E|COPYING|NOTICE)[^/]*$", str(file), re.IGNORECASE):
            continue
        path = Path(str(file.locate()))
        if not path.is_file():
            continue
        for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
            text = " ".join(line.split()).strip("#* ")
            if re.match(r"Copyright (\(c\)|©|[0-9]{4})", text, re.IGNORECASE) and len(text) < 160 and text not in seen:
                seen.add(text)
                yield text
