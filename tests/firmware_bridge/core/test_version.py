"""What `--version` prints: of a wheel, a checkout, and neither."""

from __future__ import annotations

from pathlib import Path

import pytest

from firmware_bridge.core import version

HASH = "0123456789abcdef0123456789abcdef01234567"


@pytest.fixture
def checkout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A checkout's folder in place of this one's."""
    monkeypatch.setattr(version, "_PACKAGE", tmp_path / "firmware_bridge")
    (tmp_path / "firmware_bridge").mkdir()
    (tmp_path / ".git" / "refs" / "heads").mkdir(parents=True)
    return tmp_path


def test_the_commit_of_a_wheel_is_the_one_that_it_was_built_from(checkout: Path) -> None:
    (checkout / "firmware_bridge" / "commit.txt").write_text("abc123\n")
    assert version.commit() == "abc123"


@pytest.mark.parametrize("on_a_branch", [True, False])
def test_the_commit_of_a_checkout_is_its_heads(checkout: Path, on_a_branch: bool) -> None:
    (checkout / ".git" / "refs" / "heads" / "main").write_text(f"{HASH}\n")
    (checkout / ".git" / "HEAD").write_text("ref: refs/heads/main\n" if on_a_branch else f"{HASH}\n")
    assert version.commit() == HASH[:12]


def test_a_packed_reference_is_unknown(checkout: Path) -> None:
    (checkout / ".git" / "HEAD").write_text("ref: refs/heads/main\n")
    assert version.commit() == "unknown"


def test_the_line_names_command_version_commit_and_schema(checkout: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(version, "version", lambda _: "1.2.3")
    assert version.version_line("edge-run") == "edge-run 1.2.3 (commit unknown, artifact schema 4)"


def test_a_package_that_is_not_installed_is_named_so(checkout: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def absent(name: str) -> str:
        raise version.PackageNotFoundError(name)

    monkeypatch.setattr(version, "version", absent)
    assert version.version_line("edge-run").startswith("edge-run not installed (")
