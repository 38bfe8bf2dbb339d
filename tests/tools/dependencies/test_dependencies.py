"""Licences, NOTICE, bill of materials and hashes of the packages."""

from __future__ import annotations

import json
from email.message import Message
from pathlib import Path

import pytest

from tools.dependencies.__main__ import CONSTRAINTS, HASHED, NOTICE, main
from tools.dependencies.documents import bill_of_materials, notice
from tools.dependencies.hashes import LicenceError, Platform, hashes_of, pinned_for, platforms, with_hashes
from tools.dependencies.licences import Package, Policy, installed, is_permitted, licence_of, problems, read_policy

ALLOWED = frozenset({"MIT", "Apache-2.0", "Apache-2.0 WITH LLVM-exception"})
PACKAGES = [
    Package("Beta", "2", "MIT", "https://example.org", ("base",), ("alpha",), ("Copyright (c) 2020 B",)),
    Package("alpha", "1", "GPL-3.0-only", "", ("dev",), ()),
]


@pytest.mark.parametrize(
    ("expression", "permitted"),
    [
        ("MIT", True), ("GPL-3.0-only", False), ("MIT AND GPL-3.0-only", False), ("MIT OR GPL-3.0-only", True),
        ("GPL-3.0-only OR (MIT AND Apache-2.0)", True), ("Apache-2.0 WITH LLVM-exception", True),
        ("MIT AND (GPL-3.0-only OR Apache-2.0)", True), ("Apache-2.0 WITH other", False),
    ],
)  # fmt: skip
def test_all_of_and_and_one_of_or_have_to_be_permitted(expression: str, permitted: bool) -> None:
    assert is_permitted(expression, ALLOWED) is permitted


@pytest.mark.parametrize("expression", ["", "MIT License", "(MIT", "MIT)", "AND", "MIT OR"])
def test_a_text_that_is_no_expression_is_refused(expression: str) -> None:
    with pytest.raises(LicenceError):
        is_permitted(expression, ALLOWED)


def test_a_licence_outside_the_policy_is_a_problem() -> None:
    policy = Policy(ALLOWED, {}, {}, {})
    assert problems(PACKAGES, policy) == ["alpha 1: GPL-3.0-only is not in policy.toml allowed"]


def test_an_exception_counts_only_in_its_extras() -> None:
    where = {"licence": "GPL-3.0-only", "extras": ["dev"], "why": ""}
    assert problems(PACKAGES, Policy(ALLOWED, {"alpha": where}, {}, {})) == []
    assert "found in dev" in problems(PACKAGES, Policy(ALLOWED, {"alpha": {**where, "extras": ["sim"]}}, {}, {}))[0]


def test_a_package_without_a_licence_is_a_problem() -> None:
    metadata = Message()
    metadata["Name"] = "alpha"
    assert licence_of(metadata, Policy(ALLOWED, {}, {}, {})) == ""
    assert (
        "names no licence" in problems([Package("alpha", "1", "", "", ("base",), ())], Policy(ALLOWED, {}, {}, {}))[0]
    )


@pytest.mark.slow
def test_every_package_of_this_project_has_a_permitted_licence() -> None:
    policy = read_policy()
    packages, _ = installed(policy)
    assert len(packages) > 60 and problems(packages, policy) == []


@pytest.mark.slow
def test_no_licence_of_the_gpl_reaches_an_install_for_use() -> None:
    packages, _ = installed(read_policy())
    found = {each.name for each in packages if each.licence.startswith(("GPL", "AGPL")) and set(each.extras) != {"dev"}}
    assert found == set()


@pytest.mark.slow
def test_notice_names_every_package_that_an_install_for_use_brings() -> None:
    text = NOTICE.read_text(encoding="utf-8")
    packages, _ = installed(read_policy())
    missing = [each.name for each in packages if set(each.extras) - {"dev"} and f"\n{each.name} " not in text]
    assert missing == [], "run python -m tools.dependencies notice"


def test_notice_leaves_out_what_only_tests_need() -> None:
    text = notice(PACKAGES)
    assert "Beta 2\n    licence: MIT" in text and "alpha" not in text


def test_equal_packages_give_an_equal_bill_of_materials() -> None:
    one, two = (bill_of_materials(PACKAGES, "1.0", ()) for _ in range(2))
    assert one == two and one["serialNumber"].startswith("urn:uuid:")


def test_the_bill_of_materials_links_every_package_to_what_it_needs() -> None:
    document = bill_of_materials(PACKAGES, "1.0", ("dev",))
    assert document["bomFormat"] == "CycloneDX" and document["specVersion"] == "1.6"
    links = {each["ref"]: each["dependsOn"] for each in document["dependencies"]}
    assert links["pkg:pypi/beta@2"] == ["pkg:pypi/alpha@1"]
    assert links["pkg:pypi/tic-vla-edge@1.0"] == ["pkg:pypi/beta@2"]
    assert set(links) == {each["bom-ref"] for each in document["components"]} | {"pkg:pypi/tic-vla-edge@1.0"}


@pytest.mark.slow
def test_the_command_writes_the_bill_of_materials(tmp_path: Path) -> None:
    assert main(["sbom", "--extras", "cpu", "--out", str(tmp_path / "sbom.json")]) == 0
    names = {each["name"] for each in json.loads((tmp_path / "sbom.json").read_text())["components"]}
    assert {"numpy", "onnxruntime"} <= names and "torch" not in names


def test_hashes_of_every_platform_are_merged(tmp_path: Path) -> None:
    constraints = tmp_path / "constraints.txt"
    constraints.write_text('beta==2; python_version >= "3.11"\nbeta==1; python_version < "3.11"\n')
    asked: list[list[str]] = []

    def pip(command: list[str]) -> tuple[int, str]:
        asked.append(command)
        files = [{"metadata": {"name": "beta", "version": command[-1].partition("==")[2]},
                  "download_info": {"archive_info": {"hashes": {"sha256": f"{len(asked)}" * 64}}}}]  # fmt: skip
        Path(command[command.index("--report") + 1]).write_text(json.dumps({"install": files}))
        return 0, ""

    known = [Platform(("any",), "x86_64", python, ()) for python in ("3.10", "3.11")]
    found: dict[tuple[str, str], set[str]] = {}
    for platform in known:
        found.update(hashes_of(platform, pinned_for(platform, PACKAGES, constraints), pip))  # type: ignore[arg-type]
    text = with_hashes(constraints, found, PACKAGES, known)
    assert [command[-1] for command in asked] == ["beta==1", "beta==2"]
    assert f'beta==2; python_version >= "3.11" \\\n    --hash=sha256:{"2" * 64}' in text
    assert "# platforms: x86_64-3.10 x86_64-3.11" in text


def test_a_package_that_pip_does_not_find_is_named() -> None:
    with pytest.raises(LicenceError, match="ERROR: No matching distribution found for beta"):
        hashes_of(platforms()[0], ["beta==2"], lambda _: (1, "x\nERROR: No matching distribution found for beta==2\n"))


def test_the_hashes_are_those_of_the_constraints() -> None:
    pins = {
        line.partition("\\")[0].strip() for line in HASHED.read_text().splitlines() if "==" in line and line[0] != "#"
    }
    assert pins <= set(CONSTRAINTS.read_text().splitlines())
