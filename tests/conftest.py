"""Fixtures shared by all tests."""

from __future__ import annotations

import os

import pytest


@pytest.fixture(scope="session")
def dds_domain() -> int:
    """A DDS domain of this test run's own, so that two runs on one machine never meet (ports stay below 32768)."""
    return 1 + os.getpid() % 90
