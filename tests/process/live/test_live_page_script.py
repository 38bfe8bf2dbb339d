"""The script of the live view's page in Node.js, with a clock, sockets and a document of its own: no browser."""

from __future__ import annotations

import json
import shutil
import subprocess
from importlib.resources import files
from typing import Any

import pytest

NODE = shutil.which("node")
pytestmark = [pytest.mark.process, pytest.mark.skipif(NODE is None, reason="no Node.js on this machine")]

HARNESS = """
const page = require("fs").readFileSync(0, "utf8");
const script = page.slice(page.indexOf(">", page.indexOf("<script")) + 1, page.indexOf("</script>"));
let now = 1000;
const timers = [], elements = {}, sockets = [], stops = [], found = [], drawn = [];
const draw = name => (...all) => { if (name === "fillText") drawn.push(all[0]); return { width: 8 }; };
const canvas = new Proxy({}, { get: (_, name) => draw(name), set: () => true });
const element = () => ({
  textContent: "", className: "", children: [], width: 10, height: 10, clientWidth: 10,
  replaceChildren(...all) { this.children = all; }, append(...all) { this.children.push(...all); },
  prepend(one) { this.children.unshift(one); },
  getContext: () => canvas, get parentElement() { return this; },
});
class WebSocket {
  static OPEN = 1;
  constructor() { this.readyState = 0; this.closed = false; sockets.push(this); }
  open() { this.readyState = 1; this.onopen(); }
  say(topic, stamp_ns, record) { this.onmessage({ data: JSON.stringify({ topic, stamp_ns, record }) }); }
  lose() { this.readyState = 3; this.onclose(); }
  close() { this.readyState = 3; this.closed = true; }
}
const later = (act, ms) => { const timer = { at: now + ms, act }; timers.push(timer); return timer; };
const never = timer => { if (timers.includes(timer)) timers.splice(timers.indexOf(timer), 1); };
const fetch = (path, options) => new Promise((resolve, reject) => {
  stops.push(found => resolve({ ok: true, json: async () => found }));
  if (options.signal) later(() => reject(new Error("timed out")), options.signal.ms);
});
async function advance(ms) {
  for (const end = now + ms; ; ) {
    const next = timers.filter(timer => timer.at <= end).sort((a, b) => a.at - b.at)[0];
    now = next ? Math.max(now, next.at) : end;
    if (next) { never(next); next.act(); }
    for (let k = 0; k < 20; k++) await null;  // what has been promised
    if (!next) return;
  }
}
const text = id => elements[id] ? elements[id].textContent : "";
const run = stamp_ns => sockets.at(-1).say("/run", stamp_ns, { robot: "go2", instruction: "walk" });
const tiles = () => elements.tiles.children.map(tile => tile.children.map(part => part.textContent).join(" "));
const tick = (stamp_ns, also = {}) => sockets.at(-1).say("/tick", stamp_ns, {
  late_ms: 1, duration_ms: 9, delay_s: 1, frame_age_ms: 40, pose: [1, 2, 0], trajectory: [[1, 0, 0]],
  command: [0.5, 0, 0], state: [0.4, 0, 0], active: [], reason: "", supervisor: "RUNNING", ...also,
});
require("vm").runInNewContext(script, {
  WebSocket, fetch, URLSearchParams, setTimeout: later, clearTimeout: never, requestAnimationFrame: act => act(),
  AbortSignal: { timeout: ms => ({ ms }) }, performance: { now: () => now }, window: { devicePixelRatio: 1 },
  location: { protocol: "http:", host: "robot:8765", search: "?token=t" },
  document: { getElementById: id => elements[id] ??= element(), createElement: element },
});
(async () => { SCENARIO })().then(() => console.log(JSON.stringify(found)));
"""


def watch(scenario: str) -> Any:
    """Return what a scenario has found."""
    assert NODE is not None
    page = files("edge.live").joinpath("page.html").read_text(encoding="utf-8")
    code = HARNESS.replace("SCENARIO", scenario)
    done = subprocess.run([NODE, "-e", code], input=page, capture_output=True, text=True, timeout=30)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_a_stop_without_an_answer_sends_the_operator_to_the_remote_and_ends() -> None:
    asked, late, ended = watch(
        """
        elements.stop.onclick();
        for (const ms of [100, 2000, 6100]) { await advance(ms); found.push(text("answer")); }
        """
    )
    assert asked.startswith("stopping")
    assert late == "not confirmed yet: take the robot's remote"
    assert ended.startswith("NOT CONFIRMED (timed out): use the robot's remote")


def test_a_stop_that_is_soon_confirmed_says_only_so() -> None:
    scenario = """
        elements.stop.onclick();
        await advance(900); stops[0]({ stopped: true, text: "stopped: it stands" });
        for (const ms of [10, 20000]) { await advance(ms); found.push(text("answer"), elements.answer.className); }
    """
    assert watch(scenario) == ["stopped: it stands", "cleared"] * 2


def test_a_connection_without_data_for_10_s_is_replaced() -> None:
    scenario = """
        sockets[0].open(); tick(1);
        await advance(9000); found.push(sockets.length, text("link"));
        await advance(2000); found.push(sockets.length, sockets[0].closed);
    """
    assert watch(scenario) == [1, "no data for 2 s", 2, True]


def test_a_connection_with_data_stays() -> None:
    scenario = """
        sockets[0].open();
        for (let k = 1; k <= 30; k++) { tick(k * 1e9); await advance(1000); }
        found.push(sockets.length, text("link"));
    """
    assert watch(scenario) == [1, "live"]


def test_the_old_pose_that_a_new_connection_begins_with_is_not_live() -> None:
    scenario = """
        sockets[0].open(); tick(1); await advance(11000);
        sockets[1].open(); tick(1); await advance(200); found.push(text("link"));
        tick(11.2e9); found.push(text("link"));
    """
    assert watch(scenario) == ["no data for 2 s", "live"]


def test_old_data_is_not_live() -> None:
    """A slow network delivers new poses, each 3 s later than the first ones came."""
    scenario = """
        sockets[0].open(); run(1);
        for (let k = 1; k <= 5; k++) { tick(k * 1e9); await advance(1000); }
        found.push(text("link"));
        await advance(3000);
        const shown = () => found.push(text("link"), elements.link.className);
        for (let k = 6; k <= 8; k++) { tick(k * 1e9); shown(); await advance(1000); }
        tick(12e9); shown();
    """
    assert watch(scenario) == ["live", *["data is 3.0 s old", "lost"] * 3, "live", "quiet"]


def test_a_clock_that_drifts_and_a_robot_that_restarts_keep_data_live() -> None:
    scenario = """
        sockets[0].open(); run(1);
        for (let k = 1; k <= 40; k++) { tick(k * 1e12 * (1 - 5e-5)); now += 1e6; }
        found.push(text("link"));
        await advance(11000); sockets.at(-1).open(); run(2); tick(3e9); found.push(text("link"));
    """
    assert watch(scenario) == ["live", "live"]


def test_the_link_is_stated_beside_the_stop_button_too() -> None:
    scenario = """
        sockets[0].open(); tick(1e9); await advance(100);
        const shown = () => found.push(text("link-beside-stop"), elements["link-beside-stop"].className);
        shown(); await advance(3000); shown(); sockets[0].lose(); shown();
    """
    lost = ["no data for 2 s", "lost", "connection lost, trying again", "lost"]
    assert watch(scenario) == ["live", "quiet", *lost]


def test_nothing_of_a_run_stays_when_the_next_one_drives() -> None:
    scenario = """
        sockets[0].open(); run(1); tick(2);
        sockets[0].say("/semantic", 3, { text: "Plan: go on." });
        sockets[0].say("/fault", 4, { name: "camera-stale", action: "LIMIT", change: "raised", detail: "" });
        await advance(200);
        elements.stop.onclick(); stops[0]({ stopped: true, text: "stopped: it stands" }); await advance(100);
        const { tiles, faults } = elements;
        const shown = () => [text("answer"), text("text"), tiles.children.length > 0, faults.children.length];
        found.push(shown());
        sockets[0].lose(); await advance(1100); sockets[1].open(); await advance(200); found.push(shown());
        run(5); tick(6); await advance(200); found.push(shown());
    """
    before, waiting, next_run = watch(scenario)
    assert before == ["stopped: it stands", "Plan: go on.", True, 1]
    assert waiting == ["stopped: it stands", "", False, 0], "until the next run begins, the robot stands"
    assert next_run == ["", "", True, 0]


@pytest.mark.parametrize("stopped_run", [2, None], ids=["that run", "a run not known yet"])
def test_a_stop_under_way_is_answered_although_the_next_run_appears(stopped_run: int | None) -> None:
    """The page had no connection, the next run was already driving, and its record came after the press."""
    scenario = """
        sockets[0].open(); run(1); sockets[0].lose();
        elements.stop.onclick(); await advance(1100); sockets[1].open(); run(2); found.push(text("answer"));
        await advance(1000); found.push(text("answer"));
        stops[0]({ stopped: true, text: "stopped: it stands", run: STOPPED_RUN });
        await advance(100); found.push(text("answer"), elements.answer.className);
    """
    assert watch(scenario.replace("STOPPED_RUN", json.dumps(stopped_run))) == [
        "stopping …", "not confirmed yet: take the robot's remote", "stopped: it stands", "cleared",
    ]  # fmt: skip


def test_a_stop_under_way_that_fails_says_so_although_the_next_run_appears() -> None:
    scenario = """
        sockets[0].open(); run(1); sockets[0].lose();
        elements.stop.onclick(); await advance(1100); sockets[1].open(); run(2); await advance(8000);
        found.push(text("answer"));
        run(3); found.push(text("answer"));
    """
    failed, next_run = watch(scenario)
    assert failed.startswith("NOT CONFIRMED (timed out)") and next_run == ""


def test_an_answer_to_an_earlier_runs_stop_is_not_shown_as_the_next_ones() -> None:
    scenario = """
        sockets[0].open(); run(1); elements.stop.onclick(); await advance(100);
        sockets[0].lose(); await advance(1100); sockets[1].open(); run(2);
        stops[0]({ stopped: true, text: "stopped: it stands", run: 1 }); await advance(5000);
        found.push(text("answer"), elements.answer.className);
    """
    expected = "For the run before this one: stopped: it stands. To stop this run, press STOP again"
    assert watch(scenario) == [expected, "STOP"]


def test_a_connection_that_comes_back_within_a_run_keeps_the_answer() -> None:
    scenario = """
        sockets[0].open(); run(1); elements.stop.onclick(); await advance(9000); found.push(text("answer"));
        sockets[0].lose(); await advance(1100); sockets.at(-1).open(); run(1); found.push(text("answer"));
    """
    first, second = watch(scenario)
    assert first == second and first.startswith("NOT CONFIRMED")


def test_a_run_that_has_ended_says_so_until_the_next_one() -> None:
    scenario = """
        sockets[0].open(); run(1); tick(2); sockets[0].say("/result", 3, {}); await advance(3000);
        found.push(text("link"));
        sockets[0].lose();
        found.push(text("link"));
    """
    ended, lost = watch(scenario)
    assert ended == "the run has ended"
    assert lost == "the run has ended, waiting for the next one; if it prints another address, open that"


def test_a_run_that_has_ended_says_why() -> None:
    scenario = """
        sockets[0].open(); run(1e9); sockets[0].say("/result", 3e9, { faults: ["an operator pressed the stop"] });
        found.push(elements.faults.children.map(item => item.children[0].textContent));
    """
    assert watch(scenario) == [["2.0 s · the run ended: an operator pressed the stop"]]


def test_faults_are_drawn_over_time() -> None:
    scenario = """
        sockets[0].open(); tick(1e9); await advance(200); found.push(drawn.includes("faults"));
        tick(1.1e9, { active: ["camera-frozen"] }); tick(1.2e9); await advance(200);
        found.push(drawn.includes("faults"), drawn.includes("camera-frozen"));
    """
    assert watch(scenario) == [False, True, True]


def test_missed_ticks_and_records_lost_from_the_log_are_shown() -> None:
    scenario = """
        sockets[0].open(); tick(1e9); sockets[0].say("/recorder", 1e9, { dropped: 0, error: null });
        await advance(200); found.push(tiles().length);
        tick(2e9, { missed: 2 }); sockets[0].say("/recorder", 2e9, { dropped: 7, error: "the disk is full" });
        await advance(200); found.push(tiles().length, ...tiles().filter(text => /missed|lost/.test(text)));
    """
    assert watch(scenario) == [10, 11, "10.0 ms tick, 2 missed", "7 records lost from the log: the disk is full"]
