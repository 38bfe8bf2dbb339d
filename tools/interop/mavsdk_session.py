"""A session of MAVSDK with `edge-hil --protocol mavlink`, run by MAVSDK's own Python: prints one JSON object.

python mavsdk_session.py PORT           listens on UDP PORT of the loopback, where the rover calls
python mavsdk_session.py PORT --die     drives, then dies without a word
python mavsdk_session.py PORT --watch   only watches, until its stdin ends
"""

from __future__ import annotations

import asyncio
import json
import math
import os
import socket
import sys
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from typing import Any

from mavsdk_grpc import System
from mavsdk_grpc.offboard import OffboardError, VelocityBodyYawspeed, VelocityNedYaw
from mavsdk_grpc.param import ParamError

ROUND_TRIPS = 200
ANSWER_S = 20.0


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as listening:
        return int(listening.getsockname()[1])


async def first(stream: AsyncIterator[Any], wanted: Callable[[Any], bool] = lambda _: True) -> Any:
    async def read() -> Any:
        async for value in stream:
            if wanted(value):
                return value
        raise RuntimeError("the stream has ended")

    return await asyncio.wait_for(read(), ANSWER_S)


async def refused(call: Awaitable[Any]) -> str:
    """Return MAVSDK's result of a refused request."""
    try:
        await call
    except (OffboardError, ParamError) as error:
        return str(error._result.result)
    return "accepted"


async def round_trips_ms(call: Callable[[], Awaitable[Any]]) -> dict[str, float]:
    taken = []
    for _ in range(ROUND_TRIPS):
        begin = time.perf_counter()
        await call()
        taken.append(1000 * (time.perf_counter() - begin))
    taken.sort()
    return {
        "p50_ms": round(taken[len(taken) // 2], 3),
        "p99_ms": round(taken[round(len(taken) * 0.99) - 1], 3),
        "max_ms": round(taken[-1], 3),
    }


async def drive(rover: System, vx: float, turn_deg_s: float, seconds: float) -> None:
    await rover.offboard.set_velocity_body(VelocityBodyYawspeed(vx, 0.0, 0.0, turn_deg_s))
    await asyncio.sleep(seconds)


async def connect(port: int) -> System:
    rover = System(port=free_port())
    await asyncio.wait_for(rover.connect(system_address=f"udpin://127.0.0.1:{port}"), ANSWER_S)
    await first(rover.core.connection_state(), lambda state: state.is_connected)
    return rover


async def note_texts(rover: System, texts: list[str]) -> None:
    async for text in rover.telemetry.status_text():
        texts.append(text.text)


async def die(port: int) -> None:
    rover = await connect(port)
    server = rover._server_process  # what sends the setpoints
    try:
        await rover.action.arm()
        await rover.offboard.set_velocity_body(VelocityBodyYawspeed(0.0, 0.0, 0.0, 0.0))
        await rover.offboard.start()
        await drive(rover, 0.5, 0.0, 3.0)
    finally:
        server.kill()
        server.wait()
    sys.stdout.write(json.dumps({"killed_monotonic_ns": time.monotonic_ns()}) + "\n")
    sys.stdout.flush()
    os._exit(0)


async def session(port: int) -> dict[str, Any]:
    begin = time.perf_counter()
    rover = await connect(port)
    connected_s = round(time.perf_counter() - begin, 2)
    texts: list[str] = []
    listening = asyncio.ensure_future(note_texts(rover, texts))
    try:
        seen = await visit(rover)
    finally:
        listening.cancel()
        sys.stderr.write("status texts: " + " | ".join(texts) + "\n")
        rover._stop_mavsdk_server()
    return {"connected_s": connected_s, **seen, "texts": texts}


async def visit(rover: System) -> dict[str, Any]:
    seen: dict[str, Any] = {}
    seen["version"] = str((await asyncio.wait_for(rover.info.get_version(), ANSWER_S)).flight_sw_major)
    seen["armable"] = (await first(rover.telemetry.health(), lambda health: health.is_armable)).is_armable
    battery = await first(rover.telemetry.battery())
    seen["battery"] = {"volts": round(battery.voltage_v, 2), "percent": round(battery.remaining_percent, 1)}
    await rover.telemetry.set_rate_odometry(50.0)

    seen["offboard_without_setpoint"] = await refused(rover.offboard.start())
    seen["parameters"] = {p.name: p.value for p in (await rover.param.get_all_params()).float_params}
    seen["integer_parameters"] = {p.name: p.value for p in (await rover.param.get_all_params()).int_params}
    await rover.param.set_param_float("COM_OF_LOSS_T", 0.8)
    seen["set_and_read_back"] = round(await rover.param.get_param_float("COM_OF_LOSS_T"), 3)
    await rover.param.set_param_float("COM_OF_LOSS_T", 0.5)

    await rover.action.arm()
    seen["armed"] = await first(rover.telemetry.armed(), bool)
    await rover.offboard.set_velocity_body(VelocityBodyYawspeed(0.0, 0.0, 0.0, 0.0))
    await rover.offboard.start()
    mode = await first(rover.telemetry.flight_mode(), lambda mode: str(mode) == "OFFBOARD")
    seen["mode"] = str(mode)

    start = (await first(rover.telemetry.position_velocity_ned())).position
    begin = time.perf_counter()
    samples, odometry = 0, rover.telemetry.odometry()
    await rover.offboard.set_velocity_body(VelocityBodyYawspeed(0.5, 0.0, 0.0, 0.0))
    speeds = []
    while time.perf_counter() - begin < 4.0:
        speeds.append((await anext(odometry)).velocity_body.x_m_s)
        samples += 1
    seen["odometry_hz"] = round(samples / (time.perf_counter() - begin), 1)
    seen["speed_max_mps"] = round(max(speeds), 3)
    await drive(rover, 0.0, 0.0, 1.5)
    end = await first(rover.telemetry.position_velocity_ned())
    seen["moved_m"] = round(math.hypot(end.position.north_m - start.north_m, end.position.east_m - start.east_m), 3)
    seen["end_speed_mps"] = round(math.hypot(end.velocity.north_m_s, end.velocity.east_m_s), 4)

    yaw = (await first(rover.telemetry.attitude_euler())).yaw_deg
    await drive(rover, 0.0, 30.0, 2.0)
    await drive(rover, 0.0, 0.0, 1.0)
    seen["turned_right_deg"] = round((await first(rover.telemetry.attitude_euler())).yaw_deg - yaw, 1)
    await rover.offboard.set_velocity_ned(VelocityNedYaw(0.0, 0.0, 0.0, 0.0))
    await asyncio.sleep(2.5)
    seen["yaw_after_asking_for_north_deg"] = round((await first(rover.telemetry.attitude_euler())).yaw_deg, 1)

    seen["command_round_trip"] = await round_trips_ms(lambda: rover.telemetry.set_rate_odometry(50.0))
    await rover.offboard.stop()
    seen["mode_after_stop"] = str(await first(rover.telemetry.flight_mode(), lambda mode: str(mode) != "OFFBOARD"))
    await rover.action.disarm()
    seen["armed_at_the_end"] = await first(rover.telemetry.armed(), lambda armed: not armed)

    await rover.action.arm()
    await rover.action.kill()
    seen["armed_after_kill"] = await first(rover.telemetry.armed(), lambda armed: not armed)
    try:
        await rover.action.arm()
        seen["arm_after_kill"] = "accepted"
    except Exception as error:  # noqa: BLE001 - whatever MAVSDK makes of a refusal is the result here
        seen["arm_after_kill"] = str(getattr(getattr(error, "_result", None), "result", error))
    return seen


async def watch(port: int) -> dict[str, Any]:
    rover = await connect(port)
    modes: list[str] = []
    texts: list[str] = []
    armed: set[bool] = set()
    speeds: list[float] = []

    async def note_modes() -> None:
        async for mode in rover.telemetry.flight_mode():
            if not modes or modes[-1] != str(mode):
                modes.append(str(mode))

    async def note_armed() -> None:
        async for value in rover.telemetry.armed():
            armed.add(value)

    async def note_speeds() -> None:
        async for value in rover.telemetry.position_velocity_ned():
            speeds.append(math.hypot(value.velocity.north_m_s, value.velocity.east_m_s))

    noting = [asyncio.ensure_future(each) for each in (note_modes(), note_armed(), note_speeds())]
    noting.append(asyncio.ensure_future(note_texts(rover, texts)))
    sys.stderr.write("watching\n")
    sys.stderr.flush()
    try:
        await asyncio.get_running_loop().run_in_executor(None, sys.stdin.read)
        battery = await first(rover.telemetry.battery())
    finally:
        for each in noting:
            each.cancel()
        rover._stop_mavsdk_server()
    return {
        "modes": modes,
        "armed": sorted(armed),
        "reports": len(speeds),
        "speed_max_mps": round(max(speeds, default=0.0), 3),
        "battery_percent": round(battery.remaining_percent, 1),
        "texts": texts,
    }


def main() -> int:
    port = int(sys.argv[1])
    if "--watch" in sys.argv:
        sys.stdout.write(json.dumps(asyncio.run(watch(port))) + "\n")
        return 0
    if "--die" in sys.argv:
        asyncio.run(die(port))
    sys.stdout.write(json.dumps(asyncio.run(session(port))) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
