"""The roofline's residuals: predictions beside measurements, and the intervals that these give."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from edge.core.cli import EXIT_BAD_INPUT, EXIT_DONE
from export.core.typed import FieldError
from export.model.config import PRESETS
from tools.bench.roofline import COUNTED, Measurement, intervals, load_rows, main, predict, predictions, worst

DECODE = Measurement("a board", "published", "orin", "decode", "int4-b128", "a page", tokens_per_s=50.0)


@pytest.mark.slow
def test_the_shipped_measurements_are_all_predicted(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--json", "-"]) == EXIT_DONE
    result = json.loads(capsys.readouterr().out)
    assert len(result["residuals"]) == len(load_rows()[0])
    assert {row["target"] for row in result["predictions"]} == {"orin", "rtx4060"}
    assert all(row["low_ms"] < row["ms"] < row["high_ms"] for row in result["predictions"])


def test_a_measurement_as_fast_as_the_model_has_ratio_one() -> None:
    predicted = predict(DECODE, PRESETS["1b"]).predicted.ms
    exact = predict(replace(DECODE, tokens_per_s=1e3 / predicted), PRESETS["1b"])
    assert exact.ratio == pytest.approx(1.0) and exact.inside
    slow = predict(replace(DECODE, tokens_per_s=500 / predicted), PRESETS["1b"])
    assert slow.ratio == pytest.approx(2.0) and not slow.inside


def test_twice_the_bandwidth_nearly_halves_the_predicted_time_of_decoding() -> None:
    slow, fast = (
        predict(replace(DECODE, settings=(f"roofline.memory_gbps={gbps}",)), PRESETS["1b"]) for gbps in (100, 200)
    )
    overhead_ms = 3.0
    assert slow.bound == "memory"
    assert slow.predicted.ms - overhead_ms == pytest.approx(2 * (fast.predicted.ms - overhead_ms))


@pytest.mark.slow
def test_a_fitted_row_and_other_software_change_no_interval() -> None:
    rows = [predict(replace(DECODE, tokens_per_s=rate), PRESETS["1b"]) for rate in (40.0, 60.0)]
    more = [
        predict(replace(DECODE, kind=kind, tokens_per_s=1.0), PRESETS["1b"]) for kind in ("fitted", "other-software")
    ]
    assert intervals([*rows, *more]) == intervals(rows)
    assert intervals(rows)["memory"].count == 2 and intervals(rows)["memory"].low < intervals(rows)["memory"].high


def test_the_worst_assumption_is_that_of_the_furthest_counted_ratio() -> None:
    rows = [predict(replace(DECODE, tokens_per_s=rate), PRESETS["1b"]) for rate in (90.0, 1.0)]
    found = worst(rows)["orin"]
    assert found.measurement.tokens_per_s == 1.0 and "memory_efficiency = 0.6" in found.assumption


@pytest.mark.slow
def test_a_prediction_without_any_measurement_keeps_its_own_error_bar() -> None:
    assert all(row["low_ms"] < row["ms"] < row["high_ms"] for row in predictions({}))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('[[row]]\nname = "a"', "is missing"),
        (
            '[[row]]\nname="a"\nkind="guess"\ntarget="orin"\nstage="decode"\nprecision="fp16"\nsource="s"',
            "kind 'guess'",
        ),
        ('[[row]]\nname="a"\nkind="ours"\ntarget="orin"\nstage="walk"\nprecision="fp16"\nsource="s"', "stage 'walk'"),
        ('[[row]]\nname="a"\nkind="ours"\ntarget="orin"\nstage="decode"\nprecision="fp16"\nsource="s"', "either ms or"),
        ("", "found none"),
    ],
)
def test_bad_rows_are_one_clear_line(
    text: str, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "rows.toml"
    path.write_text(text)
    assert main(["--rows", str(path)]) == EXIT_BAD_INPUT
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1


def test_a_row_of_an_unknown_network_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "rows.toml"
    path.write_text(
        '[[row]]\nname="a"\nkind="ours"\ntarget="orin"\nstage="decode"\nprecision="fp16"\nsource="s"\nms=1.0\nmodel="none"'
    )
    with pytest.raises(FieldError, match="model 'none'"):
        load_rows(path)


def test_counted_rows_are_of_other_devices_than_the_fitted_ones() -> None:
    rows, _ = load_rows()
    fitted = {row.settings for row in rows if row.kind == "fitted" and row.target == "cpu"}
    assert fitted and all(row.settings not in fitted for row in rows if row.kind in COUNTED and row.target == "cpu")
