"""Power meters on fake sysfs trees (tests/data/sysfs): rails by label, counters by difference, refusals that help."""

from __future__ import annotations

import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from edge.power.meters.ina3221 import Ina3221Meter
from edge.power.meters.meter import MODELLED, MeterError, ModelledMeter, PowerSample
from edge.power.meters.nvml import NvmlMeter
from edge.power.meters.rapl import RaplMeter
from edge.power.meters.select import open_meter
from edge.power.meters.thermal import OverCurrentEvents, ThermalReader

TREES = Path(__file__).parents[2] / "data/sysfs"
SECOND = 1_000_000_000
WATTS = {
    "orin_nx_jp5": 16.89912,
    "orin_nx_jp6": 27.602208,
    "orin_nano_jp6": 4.765312,
    "agx_orin_jp5": 20.52432,
    "agx_orin_jp6": 24.35072,
}


def copied(tmp_path: Path, board: str) -> Path:
    return Path(shutil.copytree(TREES / board, tmp_path / "sys"))


@pytest.mark.parametrize("board", sorted(WATTS))
def test_the_ina3221_trees_of_five_boards_give_the_stated_watts(board: str) -> None:
    sample = Ina3221Meter.open(TREES / board, rail="VDD_IN").read(7)
    assert sample.total_w == pytest.approx(WATTS[board], rel=1e-9)
    assert (sample.stamp_ns, sample.tagged) == (7, "measured")


@pytest.mark.parametrize("board", ["orin_nx_jp5", "orin_nx_jp6", "orin_nano_jp6"])
def test_the_modules_input_rail_is_the_total_and_the_other_rails_are_only_listed(board: str) -> None:
    sample = Ina3221Meter.open(TREES / board).read(0)
    assert sample.total_w == sample.rails["VDD_IN"]
    assert set(sample.rails) == {"VDD_IN", "VDD_CPU_GPU_CV", "VDD_SOC"}


@pytest.mark.parametrize("board", ["agx_orin_jp5", "agx_orin_jp6"])
def test_a_board_without_vdd_in_gets_a_sum_marked_as_a_lower_bound(board: str) -> None:
    meter = Ina3221Meter.open(TREES / board, rail="VDD_IN")
    assert meter.caveat is not None and "no VDD_IN" in meter.caveat and "less than it draws" in meter.caveat


@pytest.mark.parametrize("board", ["agx_orin_jp5", "agx_orin_jp6"])
def test_a_rail_that_another_one_feeds_is_not_counted_twice(board: str) -> None:
    sample = Ina3221Meter.open(TREES / board).read(0)
    assert sample.rails["VDDQ_VDD2_1V8AO"] > 0
    assert sample.total_w == pytest.approx(sum(sample.rails.values()) - sample.rails["VDDQ_VDD2_1V8AO"])


@pytest.mark.parametrize(("label", "is_rail"), [("NC", False), ("NC1", False), ("rail_NC", False), ("VDD_SYNC", True)])
def test_a_channel_that_is_not_connected_is_no_rail(tmp_path: Path, label: str, is_rail: bool) -> None:
    root = copied(tmp_path, "orin_nx_jp5")
    (root / "bus/i2c/drivers/ina3221/1-0040/hwmon/hwmon3/in3_label").write_text(f"{label}\n")
    assert set(Ina3221Meter.open(root).read(0).rails) == {"VDD_IN", "VDD_CPU_GPU_CV"} | ({label} if is_rail else set())


def test_the_hwmon_index_does_not_matter(tmp_path: Path) -> None:
    root = copied(tmp_path, "orin_nx_jp5")
    folder = root / "bus/i2c/drivers/ina3221/1-0040/hwmon"
    (folder / "hwmon3").rename(folder / "hwmon17")
    assert Ina3221Meter.open(root).read(0).total_w == pytest.approx(WATTS["orin_nx_jp5"])


def test_a_chip_that_stops_answering_is_an_error_that_names_the_rail(tmp_path: Path) -> None:
    root = copied(tmp_path, "orin_nx_jp6")
    meter = Ina3221Meter.open(root)
    (root / "bus/i2c/drivers/ina3221/1-0040/hwmon/hwmon1/curr1_input").unlink()
    with pytest.raises(MeterError, match="VDD_IN cannot be read"):
        meter.read(1)


@pytest.mark.parametrize("text", ["", "99999999999999", "nan", "12.5 mV"])
def test_a_reading_that_cannot_be_true_is_an_error_and_not_a_power(tmp_path: Path, text: str) -> None:
    root = copied(tmp_path, "orin_nx_jp6")
    meter = Ina3221Meter.open(root)
    (root / "bus/i2c/drivers/ina3221/1-0040/hwmon/hwmon1/in1_input").write_text(text)
    with pytest.raises(MeterError):
        meter.read(1)


def set_energy(root: Path, zone: str, microjoule: int) -> None:
    (root / "class/powercap" / zone / "energy_uj").write_text(f"{microjoule}\n")


def test_rapl_counts_packages_only(tmp_path: Path) -> None:
    root = copied(tmp_path, "laptop_rapl")
    meter = RaplMeter.open(root, 0)
    for zone, start, watts in (
        ("intel-rapl:0", 262143000000, 15),
        ("intel-rapl:0:0", 121500000000, 9),
        ("intel-rapl:1", 98000000000, 31),
        ("intel-rapl-mmio:0", 262143000000, 15),
    ):
        set_energy(root, zone, start + watts * 10_000)
    sample = meter.read(SECOND // 100)
    assert sample.total_w == pytest.approx(15.0)
    assert sample.rails == pytest.approx({"package-0": 15.0, "psys": 31.0})


def test_a_rapl_counter_that_starts_again_gives_the_energy_across_its_end(tmp_path: Path) -> None:
    root = copied(tmp_path, "laptop_rapl")
    meter = RaplMeter.open(root, 0)
    set_energy(root, "intel-rapl:0", 262143000000 + 20_000_000 - 262143328850)
    assert meter.read(SECOND).total_w == pytest.approx(20.0)


def test_two_rapl_readings_at_once_give_the_same_sample(tmp_path: Path) -> None:
    root = copied(tmp_path, "laptop_rapl")
    meter = RaplMeter.open(root, 0)
    set_energy(root, "intel-rapl:0", 262143000000 + 100_000)
    assert meter.read(SECOND) is meter.read(SECOND + 1)


def test_rapl_that_only_root_may_read_names_the_remedy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    root = copied(tmp_path, "laptop_rapl")
    read = Path.read_text

    def refuse(path: Path, *args: Any, **options: Any) -> str:
        if path.name == "energy_uj":
            raise PermissionError(13, "Permission denied")
        return read(path, *args, **options)

    # As root, a mode would not keep the file from being read.
    monkeypatch.setattr(Path, "read_text", refuse)
    with pytest.raises(MeterError, match=r"root only.*sudo chmod a\+r .*intel-rapl:0/energy_uj"):
        RaplMeter.open(root, 0)


class FakeNvmlError(Exception):
    """What pynvml raises."""


def fake_nvml(**changes: Any) -> Any:
    functions = {
        "NVMLError": FakeNvmlError,
        "nvmlInit": lambda: None,
        "nvmlDeviceGetHandleByIndex": lambda index: f"gpu{index}",
        "nvmlDeviceGetName": lambda handle: b"NVIDIA GeForce RTX 4060 Laptop GPU",
        "nvmlDeviceGetPowerUsage": lambda handle: 48_750,
    }
    return SimpleNamespace(**{**functions, **changes})


def refused(*_: object) -> None:
    raise FakeNvmlError("Not Supported")


def test_nvml_gives_board_power_in_watts_and_names_the_missing_consumers() -> None:
    meter = NvmlMeter.open(fake_nvml())
    assert meter.read(3).total_w == 48.75
    assert "RTX 4060" in meter.source and meter.caveat is not None and "graphics card only" in meter.caveat


@pytest.mark.parametrize("function", ["nvmlInit", "nvmlDeviceGetPowerUsage"])
def test_nvml_that_gives_nothing_is_refused_in_one_line(function: str) -> None:
    with pytest.raises(MeterError, match="Not Supported"):
        NvmlMeter.open(fake_nvml(**{function: refused}))


def test_the_modelled_meter_is_idle_power_and_the_energy_of_what_ran() -> None:
    spent = [0.0]
    meter = ModelledMeter(4.6, lambda: spent[0])
    assert meter.read(0).total_w == 4.6
    spent[0] = 5.0
    sample = meter.read(SECOND // 2)
    assert sample.total_w == pytest.approx(14.6)
    assert sample.tagged == MODELLED


def test_over_current_events_are_those_of_this_run(tmp_path: Path) -> None:
    root = copied(tmp_path, "orin_nx_jp5")
    events = OverCurrentEvents(root)
    counter = root / "devices/platform/soctherm-oc-event/hwmon/hwmon5/oc3_event_cnt"
    assert events.read() == {"oc1": 0, "oc2": 0, "oc3": 0}
    counter.write_text("27398\n")
    assert events.read()["oc3"] == 8
    counter.write_text("2\n")
    assert events.read()["oc3"] == 10


def test_over_current_counters_are_found_below_either_path() -> None:
    assert set(OverCurrentEvents(TREES / "orin_nx_jp6").read()) == {"oc1", "oc2", "oc3"}
    assert OverCurrentEvents(TREES / "laptop_rapl").read() == {}


def test_the_junction_zone_is_the_temperature_and_a_zone_that_is_off_is_none() -> None:
    state = ThermalReader(TREES / "orin_nx_jp5").read(0)
    assert state.hottest_c == 52.562
    assert "CV0-therm" not in state.zones_c


def test_without_a_junction_zone_the_hottest_zone_and_the_nearest_trip_points_count() -> None:
    state = ThermalReader(TREES / "orin_nx_jp6").read(0)
    assert state.hottest_c == 76.906
    assert state.throttle_margin_c == pytest.approx(99.0 - 76.906)
    assert state.trip_margin_c == pytest.approx(104.5 - 76.906)


def test_a_throttle_alert_is_throttling_and_a_fan_or_a_clock_cap_at_rest_is_not() -> None:
    assert ThermalReader(TREES / "orin_nx_jp6").read(0).throttling == ("gpu-throttle-alert",)
    assert not ThermalReader(TREES / "orin_nx_jp5").read(0).throttled


def test_a_surface_too_hot_to_touch_slows_nothing_down(tmp_path: Path) -> None:
    # At 71 °C a Jetson in an everyday mode has 28 °C left; its alert's own passive trip is at 70 °C.
    root = copied(tmp_path, "orin_nx_jp6")
    thermal = root / "class/thermal"
    for zone in thermal.glob("thermal_zone*/temp"):
        zone.write_text("71000\n")
    (thermal / "cooling_device2/cur_state").write_text("0\n")
    (thermal / "cooling_device3/cur_state").write_text("1\n")
    state = ThermalReader(root).read(0)
    assert state.throttling == ()
    assert state.throttle_margin_c == pytest.approx(28.0)


def test_a_passive_trip_counts_with_any_cooling_device(tmp_path: Path) -> None:
    root = copied(tmp_path, "orin_nx_jp6")
    zone = root / "class/thermal/thermal_zone0"
    (zone / "cdev1_trip_point").write_text("0\n")
    assert ThermalReader(root).read(0).throttle_margin_c == pytest.approx(70.0 - 74.281)
    for path in zone.glob("cdev*_trip_point"):
        path.unlink()
    assert ThermalReader(root).read(0).throttle_margin_c == pytest.approx(70.0 - 74.281)


def test_a_throttle_counter_of_a_processor_counts_from_the_last_reading(tmp_path: Path) -> None:
    root = copied(tmp_path, "laptop_rapl")
    reader = ThermalReader(root)
    assert not reader.read(0).throttled
    (root / "devices/system/cpu/cpu1/thermal_throttle/package_throttle_count").write_text("18\n")
    assert reader.read(1).throttling == ("cpu1 package",)
    assert not reader.read(2).throttled


def test_a_machine_without_zones_is_not_hot(tmp_path: Path) -> None:
    state = ThermalReader(tmp_path).read(0)
    assert (state.hottest_c, state.throttle_margin_c, state.trip_margin_c, state.throttled) == (None, None, None, False)


@pytest.mark.parametrize(("kind", "board"), [("ina3221", "orin_nx_jp6"), ("rapl", "laptop_rapl")])
def test_auto_takes_the_meter_that_the_machine_has(kind: str, board: str) -> None:
    meter = open_meter("auto", sysfs_root=TREES / board, nvml=fake_nvml(nvmlInit=refused), now_ns=0)
    assert meter.source.startswith(kind)


def test_auto_without_any_meter_falls_back_to_the_model_if_there_is_one() -> None:
    meter = open_meter(
        "auto", sysfs_root=TREES / "no_meter", nvml=fake_nvml(nvmlInit=refused), idle_w=4.6, energy_j=lambda: 0.0
    )
    assert isinstance(meter, ModelledMeter)


def test_auto_without_any_meter_names_every_meter_that_was_tried() -> None:
    with pytest.raises(MeterError, match=r"no power meter on this device: ina3221: looked for .*nvml: .*rapl: looked"):
        open_meter("auto", sysfs_root=TREES / "no_meter", nvml=fake_nvml(nvmlInit=refused))


@pytest.mark.parametrize(
    ("kind", "line"),
    [
        ("ina3221", "looked for .*no_meter/bus/i2c/drivers/ina3221"),
        ("rapl", "looked for .*no_meter/class/powercap/intel-rapl"),
        ("none", "names no power meter"),
        ("modelled", "the plan has no energies"),
        ("wattmeter", "not known; expected one of: auto, ina3221"),
    ],
)
def test_a_missing_meter_is_refused_with_the_path_that_was_tried(kind: str, line: str) -> None:
    with pytest.raises(MeterError, match=line):
        open_meter(kind, sysfs_root=TREES / "no_meter")


@pytest.mark.parametrize("power_w", [float("nan"), float("inf"), -1.0, 1e6])
def test_a_sample_is_never_a_power_that_cannot_be(power_w: float) -> None:
    with pytest.raises(MeterError, match="expected 0 to 2000 W"):
        PowerSample(0, power_w)
