"""Fixtures shared by all tests."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import settings

from edge.artifacts.manifest import Artifacts, load_artifacts
from export.core.cache import StageCache, open_cache

# How long an example takes says nothing about it on a shared machine.
settings.register_profile("tests", deadline=None)
settings.load_profile("tests")


@pytest.fixture(scope="session")
def dds_domain() -> int:
    """A DDS domain of this test run's own, so that two runs on one machine never meet (ports stay below 32768)."""
    return 1 + os.getpid() % 90


@pytest.fixture(scope="session", autouse=True)
def export_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A cache of finished export stages of this test run's own, also for the processes it starts."""
    before = os.environ.get("XDG_CACHE_HOME")
    os.environ["XDG_CACHE_HOME"] = str(tmp_path_factory.mktemp("cache"))
    yield Path(os.environ["XDG_CACHE_HOME"]) / "tic-vla-edge"
    if before is None:
        del os.environ["XDG_CACHE_HOME"]
    else:
        os.environ["XDG_CACHE_HOME"] = before


@pytest.fixture
def cache(export_cache: Path) -> Iterator[StageCache]:
    """That cache, opened."""
    with open_cache(export_cache, 10**10, print) as opened:
        yield opened


@pytest.fixture(scope="session")
def artifacts_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The `nano` artifacts, exported once for the whole session by the real command."""
    from export.cli import main

    out = tmp_path_factory.mktemp("artifacts") / "nano"
    assert main(["--target", "cpu", "--model", "nano", "--random-weights", "0", "--out", str(out)]) == 0
    return out


@pytest.fixture(scope="session")
def artifacts(artifacts_dir: Path) -> Artifacts:
    """The session's artifacts, verified and loaded."""
    return load_artifacts(artifacts_dir)


@pytest.fixture(scope="module")
def one_thread() -> Iterator[None]:
    """So small a network computes no faster with more, and far slower where others compute beside it."""
    import torch  # here: most tests do without it

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)
