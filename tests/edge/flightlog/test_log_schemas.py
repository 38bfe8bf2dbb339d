"""What is written to each topic of a flight log is what its schema says, so that a viewer can plot it."""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np
import pytest

from edge.core.geometry import SE2
from edge.flightlog.part import encode
from edge.flightlog.records import Throttle, battery_record, odometry_record
from edge.flightlog.schemas import SCHEMAS, Schema
from edge.odometry.drift_rate import DriftRate
from firmware_bridge.core.robot_state import BatteryState, RobotState
from tests.support.runner import synthetic_run

_TYPES: dict[str, tuple[type, ...]] = {
    "object": (dict,),
    "array": (list,),
    "string": (str,),
    "boolean": (bool,),
    "integer": (int,),
    "number": (int, float),
    "null": (type(None),),
}

STATE = RobotState(
    received_ns=1,
    T_odom_base=(1.0, 0.0, 0.1),
    vx_mps=0.4,
    vy_mps=0.0,
    wz_radps=0.0,
    mode=3,
    error_code=0,
    robot_stamp_ns=0,
    position_z_m=0.31,
    roll_rad=0.0,
    pitch_rad=0.02,
    gyro_wz_radps=0.01,
    foot_forces=(20, 21, 19, 22),
)
DRIFT = DriftRate(0.02, 0.001, 0.01, math.inf, 20.0)

SAMPLES: dict[str, dict[str, Any]] = {
    "/fault": {
        "name": "frozen-camera",
        "row": 2,
        "action": "ZERO",
        "change": "raised",
        "detail": "5 equal frames",
        "state": "DEGRADED",
        "speed_scale": 0.0,
    },
    "/power": {
        "total_w": 14.2,
        "rails": {"VDD_IN": 14.2, "VDD_CPU_GPU_CV": math.nan},
        "average_w": 13.9,
        "budget_w": 25.0,
        "level": "full",
        "pause_s": 0.0,
        "token_cap": None,
        "tagged": "measured",
        "source": "ina3221",
        "temperature_c": None,
    },
    "/odometry": odometry_record(STATE, SE2(1.0, 0.0, 0.1), np.eye(3), DRIFT, (0.4, 0.0, 0.0)),
    "/battery": battery_record(BatteryState(1, 81, 28.9, -3.2)),
    "/run": {
        "instruction": "go",
        "mode": "async",
        "artifacts": "out/nano",
        "manifest_sha256": "0" * 64,
        "robot": "go2",
        "limits": {
            "vx_min_mps": -0.4,
            "vx_max_mps": 0.8,
            "vy_max_mps": 0.3,
            "wz_max_radps": 1.0,
            "accel_mps2": 1.0,
            "alpha_radps2": 2.0,
        },
        "release_delay": {"mean_s": 0.0, "sd_s": 0.0, "seed": 0},
        "started_ns": 1,
        "tick_period_ms": 100,
    },
    "/tick": {
        **synthetic_run.tick_records(4)[-1],
        "missed": 0,
        "supervisor": "RUNNING",
        "speed_scale": 1.0,
        "active": [],
    },
    "/semantic": synthetic_run.generations(12)[0],
    "/truth": {
        "pose": [1.0, 2.0, 0.1],
        "people": [[3.0, 2.0, 0.5]],
        "people_seen": [True],
        "touching": ["person"],
        "route_m": 12.0,
        "route_bearing_rad": -0.2,
        "clearance_m": 0.8,
    },
    "/recorder": {"dropped": 3, "error": None},
    "/result": synthetic_run.run_result(4),
}


def complaints(value: Any, schema: Schema, where: str = "") -> list[str]:
    """Violations of a schema, for the keywords that ours use; a property without a schema is one too."""
    kinds = schema.get("type", list(_TYPES))
    wanted = [kinds] if isinstance(kinds, str) else kinds
    fits = any(
        isinstance(value, _TYPES[kind]) and not (isinstance(value, bool) and kind != "boolean") for kind in wanted
    )
    if not fits or value not in schema.get("enum", [value]):
        return [f"{where}: {value!r} is not {wanted}"]
    found: list[str] = []
    if isinstance(value, dict) and "properties" in schema:
        known = schema["properties"]
        found += [f"{where}.{name}: missing" for name in schema.get("required", []) if name not in value]
        found += [f"{where}.{name}: unknown" for name in value if name not in known]
        for name in set(value) & set(known):
            found += complaints(value[name], known[name], f"{where}.{name}")
    elif isinstance(value, dict) and "additionalProperties" in schema:
        for name, item in value.items():
            found += complaints(item, schema["additionalProperties"], f"{where}.{name}")
    elif isinstance(value, list):
        for item in value:
            found += complaints(item, schema.get("items", {}), f"{where}[]")
    return found


@pytest.mark.parametrize("topic", sorted(SCHEMAS))
def test_a_record_of_every_topic_conforms(topic: str) -> None:
    payload: Any = synthetic_run.jpeg(1.0) if topic == "/camera" else SAMPLES[topic]
    assert complaints(json.loads(encode(payload, 7)), SCHEMAS[topic]) == []
    if topic == "/odometry":
        unfused = odometry_record(STATE, None, None, None, None)
        assert complaints(json.loads(encode(unfused, 7)), SCHEMAS[topic]) == []


@pytest.mark.parametrize(("source_hz", "passed"), [(500, 50), (51, 50), (50, 50), (20, 20)])
def test_a_throttle_lets_the_rate_pass_and_no_more(source_hz: int, passed: int) -> None:
    throttle = Throttle(50.0)
    seconds = 20
    count = sum(throttle.due(round(index * 1e9 / source_hz)) for index in range(source_hz * seconds))
    assert count == pytest.approx(passed * seconds, rel=0.02)


def test_after_a_gap_a_throttle_does_not_make_up_for_it() -> None:
    throttle = Throttle(50.0)
    assert throttle.due(0)
    after_ns = 10_000_000_000
    assert sum(throttle.due(after_ns + index * 1_000_000) for index in range(100)) <= 6
