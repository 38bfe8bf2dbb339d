"""The live view's memory over hours: what is streamed, and what counts as growth."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from edge.flightlog.recorder import Recorder
from tests.support.runner.injections import jpeg
from tools.memory.gauge import MIB
from tools.memory.stream import judge, main, newest_report, read_recording


def readings(view_mib_per_h: float, hours: float = 8.0, feed_mib_per_h: float = 0.0) -> list[dict[str, Any]]:
    found = []
    for number in range(round(hours * 360)):
        own = {
            name: {
                column: round((50 + per_h * number / 360 + 0.001 * (number % 3)) * MIB)
                for column in ("private_dirty", "rss")
            }
            for name, per_h in (("view", view_mib_per_h), ("feed", feed_mib_per_h))
        }
        one = {"t_ns": number * 10_000_000_000, "sent": 100 + 200 * number, "dropped": min(number, 3)}
        found.append({**one, **own, "received": {"page 1": 5 + number, "foxglove 3": 9}, "failure": None})
    return found


class TestGrowth:
    def test_a_steady_view_is_within_the_limit(self) -> None:
        result = judge(readings(0.1), 8.0)
        assert result["ok"] and result["hours"] == pytest.approx(8.0, abs=0.01) and result["dropped"] == 3
        assert result["mib_per_h"]["view"]["private_dirty"]["per_h"] == pytest.approx(0.1, abs=0.01)

    @pytest.mark.parametrize(("view", "feed"), [(1.2, 0.0), (0.0, 1.2)])
    def test_growth_of_either_process_fails(self, view: float, feed: float) -> None:
        assert not judge(readings(view, feed_mib_per_h=feed), 8.0)["ok"]

    def test_growth_of_the_first_half_does_not_count(self) -> None:
        late = readings(0.0)
        for number, one in enumerate(late[: len(late) // 2]):
            one["view"]["private_dirty"] -= (len(late) // 2 - number) * 100_000
        assert judge(late, 8.0)["ok"]

    def test_a_faster_stream_grows_by_hours_of_its_recording(self) -> None:
        result = judge(readings(4.5, 1.0), 5.0, speed=5.0)
        assert result["ok"] and result["hours"] == pytest.approx(5.0, abs=0.02)
        assert result["mib_per_h"]["view"]["private_dirty"]["per_h"] == pytest.approx(0.9, abs=0.01)
        assert not judge(readings(6.0, 1.0), 5.0, speed=5.0)["ok"]

    @pytest.mark.parametrize(("rate_hz", "ok"), [(20.0, True), (21.0, False)])
    def test_a_stream_that_fell_behind_its_recording_shows_nothing(self, rate_hz: float, ok: bool) -> None:
        assert judge(readings(0.0), 8.0, rate_hz=rate_hz)["ok"] is ok  # 200 messages in 10 s were sent

    @pytest.mark.parametrize("found", [[], readings(0.0)[:5]])
    def test_too_few_readings_show_nothing(self, found: list[dict[str, Any]]) -> None:
        assert not judge(found, 0.001)["ok"]

    def test_a_stream_that_ended_early_shows_nothing(self) -> None:
        assert not judge(readings(0.0), 9.0)["ok"]

    @pytest.mark.parametrize("received", [{}, {"page 1": 0, "foxglove 3": 0}, {"page 1": 5, "foxglove 3": 0}])
    def test_viewers_that_received_nothing_show_nothing(self, received: dict[str, int]) -> None:
        found = readings(0.0)
        found[-1] |= {"received": received, "failure": "page 1: 403"}
        result = judge(found, 8.0)
        assert not result["ok"] and result["received"] == received and result["viewers_failure"] == "page 1: 403"

    def test_readings_without_a_line_of_the_viewers_show_nothing(self) -> None:
        found = readings(0.0)
        del found[-1]["received"], found[-1]["failure"]
        assert not judge(found, 8.0)["ok"]

    @pytest.mark.parametrize(("dropped", "ok"), [(990, True), (1010, False)])
    def test_a_view_that_lacks_more_than_a_hundredth_shows_nothing(self, dropped: int, ok: bool) -> None:
        """On a system whose datagrams are too small for pictures the view has little memory to grow."""
        found = readings(0.0)
        found[-1] |= {"sent": 100_000, "dropped": dropped}
        assert judge(found, 8.0)["ok"] is ok

    def test_the_newest_line_of_the_viewers_counts(self, tmp_path: Path) -> None:
        log = tmp_path / "viewers.log"
        assert newest_report(log) == {}
        log.write_text('a warning\n{"received": {"page 1": 1}, "failure": null}\n')
        with log.open("a") as file:
            file.write('{"received": {"page 1": 7}, "failure": null}\nanother warning\n{"rec')
        assert newest_report(log) == {"received": {"page 1": 7}, "failure": None}


class TestRecording:
    @staticmethod
    def record(path: Path, *, pictures: bool = True) -> Path:
        recorder = Recorder(path)
        for number in range(3):
            stamp_ns = 5_000_000_000 + number * 100_000_000
            if pictures:
                recorder.put("/camera", stamp_ns, jpeg(8, 8))
            recorder.put("/battery", stamp_ns + 1, {"soc_percent": 80.0, "voltage_v": 29.0, "current_a": 1.0})
        recorder.close()
        return path

    def test_it_has_the_runners_records_and_pictures_by_their_time(self, tmp_path: Path) -> None:
        recording = read_recording(self.record(tmp_path / "flight.mcap"))
        assert [topic for _, topic, _ in recording.messages] == ["/camera", "/battery"] * 3
        assert [at for at, topic, _ in recording.messages if topic == "/camera"] == pytest.approx([0.0, 0.1, 0.2])
        assert recording.messages[0][2] == jpeg(8, 8) and recording.seconds == pytest.approx(0.3)

    def test_a_log_without_pictures_is_refused_in_one_line(
        self, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        log = self.record(tmp_path / "flight.mcap", pictures=False)
        assert main([str(log), "--out", str(tmp_path / "out")]) == 2
        assert "no picture in it" in capsys.readouterr().err and not (tmp_path / "out").exists()

    @pytest.mark.parametrize(
        "option", [*(("--hours", hours) for hours in ("0", "-1", "nan", "1000")), ("--speed", "0"), ("--speed", "nan")]
    )
    def test_absurd_durations_and_speeds_are_refused(self, option: tuple[str, str], tmp_path: Path) -> None:
        log = self.record(tmp_path / "flight.mcap")
        assert main([str(log), *option, "--out", str(tmp_path / "out")]) == 2
