"""Tests that run beside each other, in workers or in two runs at once, must not disturb each other."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.support.processes import claimed_dds_domain

MODULES = sorted(Path(__file__).parent.rglob("test_*.py"))
STARTS = re.compile(r"^from tests\.support\.processes import (\([^)]*|.*)\brunning\b", re.MULTILINE)
MARKED = re.compile(r"^pytestmark = (pytest\.mark\.process$|\[\s*pytest\.mark\.process,)", re.MULTILINE)


@pytest.mark.parametrize("module", MODULES, ids=lambda path: path.stem)
def test_a_module_that_starts_commands_in_real_time_runs_alone(module: Path) -> None:
    text = module.read_text(encoding="utf-8")
    assert not STARTS.search(text) or MARKED.search(text)


def test_a_claimed_dds_domain_is_given_once() -> None:
    with claimed_dds_domain() as one, claimed_dds_domain() as other:
        assert one != other
