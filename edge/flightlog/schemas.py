"""JSON schemas of the runner's own records in the flight log, so that a viewer can list and plot the fields.

A table, not code: one entry per topic. Names carry their units; stamps are monotonic ns of the recording machine. A
number that is not finite is null in the log, so whatever is computed may be null.
"""

from __future__ import annotations

from collections.abc import Mapping

from edge.flightlog.standard_schemas import COMPRESSED_IMAGE, Schema

_ANY: Schema = {}
_INT: Schema = {"type": "integer"}
_NUMBER: Schema = {"type": "number"}
_TEXT: Schema = {"type": "string"}
_TEXT_OR_NULL: Schema = {"type": ["string", "null"]}
_BOOL: Schema = {"type": "boolean"}
_INT_OR_NULL: Schema = {"type": ["integer", "null"]}
_NUMBER_OR_NULL: Schema = {"type": ["number", "null"]}
_TEXTS: Schema = {"type": "array", "items": _TEXT}
_VECTOR: Schema = {"type": "array", "items": _NUMBER_OR_NULL}
_VECTOR_OR_NULL: Schema = {"type": ["array", "null"], "items": _NUMBER_OR_NULL}
_ROWS: Schema = {"type": "array", "items": _VECTOR}
_ROWS_OR_NULL: Schema = {"type": ["array", "null"], "items": _VECTOR}
_NUMBERS_BY_NAME: Schema = {"type": "object", "additionalProperties": _NUMBER_OR_NULL}


def _record(title: str, optional: tuple[str, ...] = (), **properties: Schema) -> Schema:
    """An object with these properties; all but the optional ones are always there."""
    required = [name for name in properties if name not in optional]
    return {"title": title, "type": "object", "properties": properties, "required": required}


SCHEMAS: Mapping[str, Schema] = {
    "/run": _record(
        "tic_vla.Run",
        ("limits", "mount", "release", "decoding", "recovery", "stand_at_goal", "speculation"),
        instruction=_TEXT,
        mode=_TEXT,
        decoding=_TEXT,  # Switches: what was in force
        recovery=_TEXT,
        stand_at_goal=_BOOL,
        speculation=_TEXT,
        artifacts=_TEXT,
        manifest_sha256=_TEXT,
        release=_INT_OR_NULL,  # counter of the artifacts' signature
        robot=_TEXT,
        limits=_NUMBERS_BY_NAME,  # LimitsConfig: what the commands were held to
        mount={"type": ["object", "null"], "additionalProperties": _NUMBER_OR_NULL},  # of the camera
        release_delay=_ANY,
        started_ns=_INT,
        tick_period_ms=_NUMBER,
    ),
    "/tick": _record(
        "tic_vla.Tick",
        ("missed", "delay_given_s", "offset_sd", "supervisor", "speed_scale", "active"),
        tick=_INT,
        missed=_INT,  # ticks left out so far because an earlier one was late
        now_ns=_INT,
        start_ns=_INT,
        duration_ms=_NUMBER,
        late_ms=_NUMBER,
        encode_ms=_NUMBER_OR_NULL,
        act_ms=_NUMBER_OR_NULL,
        frame_ns=_INT_OR_NULL,
        frame_age_ms=_NUMBER_OR_NULL,
        generation=_INT_OR_NULL,
        anchor_ns=_INT_OR_NULL,
        delay_s=_NUMBER_OR_NULL,
        delay_given_s=_NUMBER_OR_NULL,  # as the policy received it: within its training range
        offset=_VECTOR_OR_NULL,
        offset_sd=_VECTOR_OR_NULL,  # standard deviations of the offset, m, m, rad
        pose=_VECTOR_OR_NULL,
        state=_VECTOR_OR_NULL,  # vx m/s, vy m/s, ωz rad/s
        trajectory=_ROWS_OR_NULL,  # (x m, y m, θ rad) at whole seconds
        target=_VECTOR_OR_NULL,
        command=_VECTOR,
        reason=_TEXT,
        supervisor=_TEXT,  # STARTING, READY, RUNNING, DEGRADED, STOPPED
        speed_scale=_NUMBER,
        active=_TEXTS,  # names of the faults present
    ),
    "/semantic": _record(
        "tic_vla.Semantic",
        (
            "instruction",
            "frame_poses",
            "way",
            "before",
            "follow",
            "turn",
            "turn_left_m",
            "turn_may_be_done",
            "keeps_form",
            "overruled",
            "planned",
            "stop",
            "max_new_tokens",
            "decode_calls",
            "call_tokens",
            "published_ns",
        ),
        generation=_INT,
        instruction=_TEXT,  # the run's, or another that was given later
        anchor_ns=_INT,
        anchor_pose=_VECTOR_OR_NULL,
        started_ns=_INT,
        finished_ns=_INT,
        ready_ns=_INT,
        published_ns=_INT,  # when the control thread could read it
        release_delay_s=_NUMBER,
        frames_ns={"type": "array", "items": _INT},  # stamps of /camera, oldest first
        frame_poses=_ROWS,  # (x m, y m, θ rad) at those
        way=_ROWS,  # (x m, y m) in the robot frame at the anchor: the prompt's past motion
        before=_TEXT,  # the progress in the prompt, "none." without one
        follow=_TEXT,  # progress allowed after it: free, onward, either way
        turn=_TEXT_OR_NULL,  # left or right: the turn that was next then
        turn_left_m=_VECTOR_OR_NULL,  # its distance by each earlier observation
        turn_may_be_done=_BOOL,  # whether the robot can have made it, by odometry
        keeps_form=_BOOL,  # whether situation and plan were kept within the grammar
        overruled=_BOOL,  # whether the model would have decoded another progress
        planned=_TEXT,  # the plan's line as the model decoded it, where another distance was required
        stop=_VECTOR_OR_NULL,  # (x m, y m, θ rad) in the odometry's frame: where the answers mean to stop
        prompt_tokens=_INT,
        max_new_tokens=_INT,
        new_tokens=_INT,
        decode_calls=_INT,  # calls that chose the new tokens
        call_tokens={"type": "array", "items": _INT},  # tokens that each of them fed: the last one and the guesses
        text=_TEXT,
        waypoints=_ROWS_OR_NULL,
        prefill_ms=_NUMBER,
        decode_ms=_NUMBER,
        context_ms=_NUMBER,
    ),
    "/camera": COMPRESSED_IMAGE,
    "/fault": _record(
        "tic_vla.Fault",
        name=_TEXT,
        row=_INT_OR_NULL,  # of the fault matrix
        action=_TEXT,  # LIMIT, ZERO, STOP
        change={"enum": ["raised", "cleared"]},
        detail=_TEXT,
        state=_TEXT,  # of the supervisor, after it
        speed_scale=_NUMBER,
    ),
    "/power": _record(
        "tic_vla.Power",
        ("stamp_ns",),
        stamp_ns=_INT,
        total_w=_NUMBER_OR_NULL,
        rails=_NUMBERS_BY_NAME,  # W by label
        average_w=_NUMBER_OR_NULL,
        budget_w=_NUMBER_OR_NULL,
        level=_TEXT,  # of the governor
        pause_s=_NUMBER,
        token_cap=_INT_OR_NULL,
        tagged=_TEXT,  # measured, modelled
        source=_TEXT,
        temperature_c=_NUMBER_OR_NULL,
    ),
    "/odometry": _record(
        "tic_vla.Odometry",
        ("roll_rad", "pitch_rad", "foot_forces"),
        raw_pose=_VECTOR,  # x m, y m, θ rad, as the robot reports
        velocity=_VECTOR,  # vx m/s, vy m/s, ωz rad/s
        gyro_wz_radps=_NUMBER_OR_NULL,
        roll_rad=_NUMBER_OR_NULL,
        pitch_rad=_NUMBER_OR_NULL,
        foot_forces=_VECTOR,  # FR, FL, RR, RL, as the robot counts
        pose=_VECTOR_OR_NULL,  # fused
        covariance=_ROWS_OR_NULL,  # 3×3 of the motion since the anchor that is driven by, m² and rad²
        drift_m_per_m=_NUMBER_OR_NULL,
        drift_deg_per_m=_NUMBER_OR_NULL,
        command=_VECTOR_OR_NULL,
    ),
    "/battery": _record(
        "tic_vla.Battery",
        soc_percent=_NUMBER_OR_NULL,
        voltage_v=_NUMBER_OR_NULL,
        current_a=_NUMBER_OR_NULL,
    ),
    "/truth": _record(
        "tic_vla.Truth",  # only where a simulator knows it
        ("people_seen", "route_m", "route_bearing_rad", "clearance_m"),
        pose=_VECTOR,  # x m, y m, θ rad in the world
        people=_ROWS,  # (x m, y m, heading rad) of those within 10 m
        people_seen={"type": "array", "items": _BOOL},  # whether no solid hides each of them from the camera
        touching={"type": "array", "items": _TEXT},  # labels of what the robot touches
        route_m=_NUMBER_OR_NULL,  # length of the shortest path to the goal
        route_bearing_rad=_NUMBER_OR_NULL,  # direction of its point 3 m ahead, seen from the robot
        clearance_m=_NUMBER_OR_NULL,  # to the nearest object
    ),
    "/recorder": _record(
        "tic_vla.Recorder",  # live only: state of the flight log
        dropped=_INT,  # records that may be missing in it
        error=_TEXT_OR_NULL,  # why nothing is written
    ),
    "/result": {"title": "tic_vla.Result", "type": "object"},
}

ANY_OBJECT: Schema = {"title": "tic_vla.Object", "type": "object"}
"""For a topic that is not in the table."""
