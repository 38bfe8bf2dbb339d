"""Fixtures shared by all tests."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import Phase, settings

from edge.artifacts.manifest import Artifacts, load_artifacts
from export.core.cache import StageCache, open_cache
from tests.support.processes import claimed_dds_domain, locked

# `tests` gives the same few examples in every run and does not shrink a failing one: shrinking may take five minutes.
# `seeded` is the same with examples of the seed that CI prints; `random` is what `make test-random` asks for: more
# examples, with a seed that it prints. How long an example takes is no evidence on a shared machine.
settings.register_profile(
    "tests",
    max_examples=40,
    derandomize=True,
    deadline=None,
    print_blob=True,
    phases=(Phase.explicit, Phase.generate),
)
settings.register_profile("seeded", settings.get_profile("tests"), derandomize=False, database=None)
settings.register_profile("random", deadline=None, print_blob=True, database=None)
settings.load_profile("tests")


@pytest.fixture(scope="session")
def run_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of this test run that all its workers share, and with EDGE_TEST_FOLDER the tests of both kinds."""
    if "EDGE_TEST_FOLDER" in os.environ:
        return Path(os.environ["EDGE_TEST_FOLDER"])
    folder = tmp_path_factory.getbasetemp()
    return folder.parent if "PYTEST_XDIST_WORKER" in os.environ else folder


@pytest.fixture(scope="session")
def dds_domain() -> Iterator[int]:
    """DDS domain of this worker of this test run alone."""
    with claimed_dds_domain() as domain:
        yield domain


@pytest.fixture(scope="session", autouse=True)
def export_cache(run_folder: Path) -> Iterator[Path]:
    """Cache of finished export stages for this test run alone, shared by its workers and the processes they start."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(run_folder / "cache"))
        yield run_folder / "cache" / "tic-vla-edge"


@pytest.fixture
def cache(export_cache: Path) -> Iterator[StageCache]:
    """That cache, opened."""
    with open_cache(export_cache, 10**10, print) as opened:
        yield opened


@pytest.fixture(scope="session")
def nano_dir(run_folder: Path) -> Path:
    """The `nano` artifacts, exported by the real command: once in a run, by the worker that needs them first."""
    return _exported(run_folder, "nano", "nano")


@pytest.fixture(scope="session")
def narrow_model(run_folder: Path) -> Path:
    """Configuration of a narrow network with nano's inputs and texts."""
    from tools.train.config.recipe import load_recipe

    file = run_folder / "narrow.json"
    with locked(run_folder / "artifacts.lock", wait=True):
        if not file.exists():
            file.write_text(json.dumps(load_recipe("tiny").model.to_dict()), encoding="utf-8")
    return file


@pytest.fixture(scope="session")
def artifacts_dir(run_folder: Path, narrow_model: Path) -> Path:
    """Artifacts of the narrow network: 1.8 MB, so that their hashes cost a test next to nothing."""
    return _exported(run_folder, "narrow", str(narrow_model))


def _exported(run_folder: Path, name: str, model: str) -> Path:
    out = run_folder / "artifacts" / name
    with locked(run_folder / "artifacts.lock", wait=True):
        if not out.exists():
            from export.cli import main  # here: it loads torch, which those who find the artifacts do without

            assert main(["--target", "cpu", "--model", model, "--random-weights", "0", "--out", str(out)]) == 0
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
