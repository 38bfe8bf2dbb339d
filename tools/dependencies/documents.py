"""Formats the NOTICE file and a CycloneDX bill of materials from the installed packages."""

from __future__ import annotations

import hashlib
import json
import uuid
from collections.abc import Sequence
from typing import Any, Final

from packaging.utils import canonicalize_name

from tools.dependencies.licences import BASE, PROJECT, Package

_NAMESPACE: Final = uuid.UUID("6ba7b811-9dad-11d1-80b4-00c04fd430c8")  # RFC 9562, URLs
_TEST_ONLY: Final = ("dev",)
_LINES: Final = 3
"""Copyright lines of a package in NOTICE; its own licence file has all."""

HEAD: Final = """\
TIC-VLA edge
Copyright the authors of TIC-VLA edge

Licensed under the Apache License, Version 2.0 (LICENSE).

This project's wheel contains no code of others. pip installs the packages below beside it; each has its own licence
file in its .dist-info folder. A container image or a board image that contains them has to keep these files.
Made by `python -m tools.dependencies notice`; do not edit it.
"""


def notice(packages: Sequence[Package]) -> str:
    """Return the NOTICE file: every package that an install for use brings, by name."""
    parts = [HEAD]
    for package in packages:
        extras = [extra for extra in package.extras if extra not in _TEST_ONLY]
        if not extras:
            continue
        lines = [
            f"{package.name} {package.version}",
            f"    licence: {package.licence}",
            f"    with: {', '.join(extras)}",
        ]
        if package.homepage:
            lines.append(f"    source: {package.homepage}")
        lines += [f"    {line}" for line in package.copyrights[:_LINES]]
        parts.append("\n".join(lines) + "\n")
    return "\n".join(parts)


def bill_of_materials(packages: Sequence[Package], version: str, extras: Sequence[str]) -> dict[str, Any]:
    """Return a CycloneDX 1.6 document of the packages of some extras; equal inputs give equal bytes."""
    chosen = [package for package in packages if set(package.extras) & {BASE, *extras}]
    references: dict[str, str] = {
        canonicalize_name(package.name): _purl(package.name, package.version) for package in chosen
    }
    root = _purl(PROJECT, version)
    components = [
        {
            "type": "library",
            "bom-ref": references[canonicalize_name(package.name)],
            "name": package.name,
            "version": package.version,
            "purl": references[canonicalize_name(package.name)],
            "licenses": [{"expression": package.licence}],
            **({"externalReferences": [{"type": "website", "url": package.homepage}]} if package.homepage else {}),
        }
        for package in chosen
    ]
    needed = {name for package in chosen for name in package.needs}
    top = sorted(reference for name, reference in references.items() if name not in needed)
    dependencies = [{"ref": root, "dependsOn": top}]
    dependencies += [
        {
            "ref": references[canonicalize_name(package.name)],
            "dependsOn": sorted(references[name] for name in package.needs if name in references),
        }
        for package in chosen
    ]
    document: dict[str, Any] = {
        "bomFormat": "CycloneDX",
        "specVersion": "1.6",
        "version": 1,
        "metadata": {
            "component": {
                "type": "application", "bom-ref": root, "name": PROJECT, "version": version, "purl": root,
                "licenses": [{"expression": "Apache-2.0"}],
            }
        },
        "components": components,
        "dependencies": dependencies,
    }  # fmt: skip
    digest = hashlib.sha256(json.dumps(document, sort_keys=True).encode()).hexdigest()
    return {**document, "serialNumber": f"urn:uuid:{uuid.uuid5(_NAMESPACE, digest)}"}


def _purl(name: str, version: str) -> str:
    return f"pkg:pypi/{canonicalize_name(name)}@{version}"
