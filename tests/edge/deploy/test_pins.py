"""Pinned packages in the wheel: which of them a board installs."""

from __future__ import annotations

import zipfile
from pathlib import Path

import pytest

from edge.deploy.pins import FILE, PinsError, parse_pins, pinned_steps, pins_of, read_pins, wheel_extras

HASHED = Path(__file__).resolve().parents[3] / "constraints-hashed.txt"
SHIPPED = HASHED.read_text(encoding="utf-8")


def test_the_base_install_is_pinned_and_an_extra_only_where_it_is_chosen() -> None:
    pins = parse_pins(SHIPPED)
    base, can = (pins.for_board("aarch64", (3, 11), extras) for extras in ((), ("can",)))
    assert base is not None and "numpy==" in base and "python-can==" not in base
    assert can is not None and "python-can==" in can


def test_every_pin_has_a_hash() -> None:
    text = parse_pins(SHIPPED).for_board("x86_64", (3, 11), ("cpu", "unitree", "mavlink", "can", "sign")) or ""
    assert text.count("==") >= 40
    assert all("--hash=sha256:" in entry for entry in text.replace("\\\n", "").splitlines())


def test_an_unknown_platform_has_no_pins() -> None:
    assert parse_pins(SHIPPED).for_board("riscv64", (3, 11), ()) is None


def test_a_wheel_without_pins_says_so(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "x.whl", "w") as archive:
        archive.writestr("edge/__init__.py", "")
    assert read_pins(tmp_path / "x.whl") is None
    assert pins_of(tmp_path / "x.whl", (), "x86_64") == (None, "the wheel has no pinned packages")


@pytest.mark.parametrize(
    "text", ["", "a==1\n", "# platforms: x\n# extras: base\na==1\n", "# platforms: x\n# extras: base\n"]
)
def test_a_file_without_hashes_is_refused(text: str, tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "x.whl", "w") as archive:
        archive.writestr(FILE, text)
    with pytest.raises(PinsError):
        read_pins(tmp_path / "x.whl")


@pytest.mark.parametrize("damage", ["deflate", "metadata"])
def test_a_damaged_wheel_is_refused(damage: str, tmp_path: Path) -> None:
    wheel, name = tmp_path / "x.whl", "x.dist-info/METADATA"
    content = b"\xff\xfe" if damage == "metadata" else b"Name: tic-vla-edge\n" * 100
    with zipfile.ZipFile(wheel, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(name, content)
    if damage == "deflate":
        data = bytearray(wheel.read_bytes())
        begin = data.index(name.encode()) + len(name)
        data[begin] = 0xFF  # a block of a reserved type
        wheel.write_bytes(bytes(data))
    with pytest.raises(PinsError, match=r"not a whole wheel .*copy it again"):
        wheel_extras(wheel)


def test_a_wheel_that_expands_to_far_more_than_a_wheel_has_is_refused_unread(tmp_path: Path) -> None:
    wheel = tmp_path / "x.whl"
    with zipfile.ZipFile(wheel, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("x.dist-info/METADATA", b"Name: tic-vla-edge\n" + bytes(2_000_000))
    with pytest.raises(PinsError, match="once unpacked"):
        wheel_extras(wheel)


def test_pip_installs_pins_by_hash_and_resolves_nothing_itself(tmp_path: Path) -> None:
    ran: list[list[str]] = []

    def command(words: list[str]) -> tuple[int, str]:
        ran.append(words)
        return 0, ""

    pip = ["python", "-m", "pip", "install"]
    for step in pinned_steps(tmp_path / "pins.txt", "a==1\n", pip, Path("x.whl"), ("b",), command)[1:]:  # type: ignore[arg-type]
        step.act(None)  # type: ignore[arg-type]
    assert ran == [
        [*pip, "--no-deps", "--require-hashes", "-r", str(tmp_path / "pins.txt")],
        [*pip, "--no-deps", "x.whl"],
        [*pip, "b"],
        ["python", "-m", "pip", "check"],
    ]
