"""Write the fault table as a page: what can go wrong, what the robot does, and how soon.

python -m tools.fault_table > docs/faults.md
"""

from __future__ import annotations

import sys

from edge.safety.faults.table import FAULTS, NOT_HERE, Action, Fault

HEAD = """# What can go wrong

Made from `edge/safety/faults/table.py` by `python -m tools.fault_table`; do not edit.
*Row* is the number that code, tests and the soak's budget name as the fault matrix's row.
*Bound* runs from the fault's effect at our input to the velocity on the wire. The bound of `camera-frozen` holds for
pictures that are equal byte for byte; a scene that stays the same under noise, a clock or a new JPEG encoding is found
by distance, after about 0.25 m or 12° of motion. The actions:

* **nothing**: control must not change; the fault is dropped or counted.
* **limit**: the speed limit is lowered to the share that is given, the arc is kept; `semantic-old` lowers it with age;
  without a share the operator reads the message and nothing else changes.
* **zero**: zero velocity until the fault has been gone for its clear time.
* **stop**: zero velocity until the robot is armed again.

Emergency stops; the bridge refuses to arm until `edge-bridge arm`:

* L2 and B on the robot's remote, or the GPIO switch: they need neither a runner nor a terminal.
* `edge-bridge stop`: it needs no runner.
* `edge-say stop --to PATH`, also "halt", "freeze", "emergency stop" or "stop now": the bridge stops the robot and the
  runner ends its run. Exit code 0 means that the bridge has confirmed the stop. Where no bridge admits this user, the
  runner stops the robot alone: then a new run may arm without `edge-bridge arm`, and edge-say says so.

No emergency stops:

* `edge-say "stop at the door"`, or any longer text: **the robot drives on**. The text is an instruction for the model.
* The end of the runner (Ctrl-C, SIGTERM, SIGKILL): the bridge stops the robot, but a new run may arm by itself.

| row | fault | where | action | bound | ends | message | next step |
|---:|---|---|---|---:|---|---|---|
"""


def _action(fault: Fault) -> str:
    share = f" to {fault.speed_scale:.0%}" if fault.action is Action.LIMIT and fault.speed_scale < 1 else ""
    return fault.action.value + share


def _ends(fault: Fault) -> str:
    if fault.action is Action.NOTHING:
        return ""
    ends = "at the next arming" if fault.latch else f"{fault.clear_ms / 1000:g} s after it was last found"
    if fault.escalation is None:
        return ends
    rule = fault.escalation
    return f"{ends}; {rule.count} in {rule.window_ms / 1000:g} s are `{rule.to}`"


def page() -> str:
    """Render the table as Markdown, ordered by row."""
    lines = [
        f"| {fault.row} | `{fault.name}` | {fault.where} | {_action(fault)} | "
        f"{f'{fault.bound_ms} ms' if fault.bound_ms else ''} | {_ends(fault)} | {fault.message} | {fault.advice} |"
        for fault in sorted(FAULTS.values(), key=lambda fault: (fault.row, fault.bound_ms))
    ]
    left_out = [f"* row {row}: {why}" for row, why in sorted(NOT_HERE.items())]
    return HEAD + "\n".join(lines) + "\n\nRows that are not here:\n\n" + "\n".join(left_out) + "\n"


if __name__ == "__main__":
    sys.stdout.write(page())
