"""The contract of every backend, for both shipped CAN bases on a virtual bus."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.support.robot.backend_contract import BackendContract
from tests.support.robot.dbc_base import CARTER, EXAMPLE, CanRig


class TestCarter(BackendContract):
    FILE = CARTER

    @pytest.fixture
    def rig(self) -> Iterator[CanRig]:
        rig = CanRig(CARTER)
        yield rig
        rig.close()


class TestExampleBase(BackendContract):
    """Another DBC file and robot file, and not one line of code for it."""

    FILE = EXAMPLE

    @pytest.fixture
    def rig(self) -> Iterator[CanRig]:
        rig = CanRig(EXAMPLE)
        yield rig
        rig.close()
