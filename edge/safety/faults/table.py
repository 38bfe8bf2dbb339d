"""The fault table: everything that can go wrong without a real robot or GPU being needed to test it.

One fault is one thing that can be found. Several may share a row of the fault matrix (facts, "Fault-injection matrix"),
where the speed is limited first and the robot stopped later. The supervisor, the documents and `make faults` read it.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from edge.safety.faults.row import LAST_ROW, Action, Escalation, Fault, table
from edge.safety.faults.rows_outside import BRIDGE, FAULT_OF_CAUSE, START
from edge.safety.faults.rows_runner import INPUTS, MACHINE, MODEL

__all__ = ["FAULTS", "FAULT_OF_CAUSE", "LAST_ROW", "NOT_HERE", "Action", "Escalation", "Fault"]

FAULTS: Mapping[str, Fault] = table(INPUTS, MODEL, MACHINE, BRIDGE, START)
"""Every fault by name."""

NOT_HERE: Mapping[int, str] = MappingProxyType(
    {
        32: "needs a real robot: power cut of the computer with the bridge",
        49: "needs a bench supply on a real board",
        61: "a leak shows in hours: judged by the soak, not by an injection",
        62: "jitter of the bridge under memory pressure: judged by the soak, not by an injection",
        63: "needs a depth sensor or lidar: no robot file has one",
    }
)
"""Rows of the matrix that the table leaves out, each with its reason."""
