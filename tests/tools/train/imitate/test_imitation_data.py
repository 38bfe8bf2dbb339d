"""A sample is a frame, an older semantic state, and exactly how far apart they are; nothing in it is of the future."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

from edge.core.geometry import SE2
from edge.inference.latency_profile import LatencyError, LatencyProfile
from edge.motion.controller import arc_to
from edge.state.semantic import waypoints_now
from export.model.config import TicVlaConfig
from export.model.network import build
from export.model.tokenizers.nano import NANO_TOKENIZER
from tests.support.train.train_drives import MadeUpTokens, tiny_model, write_dataset
from tests.support.train.train_imitate_rank import FRAMES, SideStates, side_dataset, side_drive
from tools.train.config.checks import TrainError
from tools.train.config.imitate import DelayConfig, KvConfig, SampleConfig, WeightConfig
from tools.train.drives.drive import NOISE, Dataset, Drive
from tools.train.imitate.data import Delays, SampleChoice, SampleError, Samples, States
from tools.train.samples.action_batch import Group
from tools.train.samples.drive_frames import LEAST_KNOWN, DriveFrames
from tools.train.samples.kv_cache import CachedState, build_kv_cache

TEN_S = Delays.uniform(DelayConfig())
PLAIN = SampleConfig().undisturbed()
EVEN = PLAIN.weights
TOKENS = MadeUpTokens()


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return side_dataset(tmp_path_factory.mktemp("collect"))


def of(
    dataset: Dataset,
    config: SampleConfig = PLAIN,
    delays: Delays = TEN_S,
    model: TicVlaConfig | None = None,
    states: States | None = None,
    *,
    drop: bool = False,
) -> Samples:
    drives = [DriveFrames.of(drive, 30, config.weights) for drive in dataset.drives(dataset.train)]
    return Samples(drives, TOKENS, states or SideStates(dataset), delays, config, model or tiny_model(), drop=drop)


def with_interface(name: str) -> TicVlaConfig:
    model = tiny_model()
    return dataclasses.replace(model, action=dataclasses.replace(model.action, semantic_interface=name))


def drawn(samples: Samples, count: int, seed: int = 0) -> list[tuple[SampleChoice, Group]]:
    found = []
    for number in range(count):
        rng = np.random.default_rng((seed, number))
        chosen = samples.choose(rng)
        found.append((chosen, samples.take(chosen, rng)))
    return found


@pytest.mark.slow
def test_age_and_motion_offset_are_exactly_those_between_state_and_frame(dataset: Dataset) -> None:
    samples = of(dataset)
    for chosen, group in drawn(samples, 60):
        drive = dataset.load(samples.drives[chosen.drive].id, pictures=False)
        assert chosen.anchor % 10 == 0
        np.testing.assert_array_equal(group.guidance[0, :, 1], np.float16(chosen.anchor / 100))
        for k, age, latency in zip(chosen.ks, chosen.ages, group.latency, strict=True):
            assert age == k - chosen.anchor
            assert latency[0] == np.float32((k - chosen.anchor) / 10)
            anchor, now = (SE2(*map(float, drive.pose_odom[i])) for i in (chosen.anchor, k))
            np.testing.assert_allclose(latency[1:], (anchor.inverse() @ now).as_tuple(), atol=1e-6)


def test_picture_state_and_label_are_those_of_the_frame(dataset: Dataset) -> None:
    samples = of(dataset)
    for chosen, group in drawn(samples, 30):
        drive = dataset.load(samples.drives[chosen.drive].id, pictures=False)
        ks = list(chosen.ks)
        np.testing.assert_array_equal(group.visual_tokens, TOKENS.frames(drive.id)[ks])
        np.testing.assert_array_equal(group.state, drive.state[ks])
        np.testing.assert_allclose(group.target, drive.future[ks, :30], atol=1e-6)
        np.testing.assert_array_equal(group.known.sum(1), np.minimum(drive.future_steps[ks], 30))
        for k, goal in zip(ks, group.goal, strict=True):
            here = SE2(*map(float, drive.pose[k]))
            there = here.inverse() @ SE2(*drive.about.goal_xy, 0.0)
            np.testing.assert_allclose(goal, (there.x_m, there.y_m), atol=1e-5)


def spoiled(drive: Drive, k: int) -> Drive:
    """The drive with everything after frame k, and whatever is only known later, made up anew."""
    rng = np.random.default_rng(99)
    later = slice(k + 1, None)
    changed = {}
    for name in ("pose", "pose_odom", "state", "future", "plan_xy"):
        array = getattr(drive, name).copy()
        array[later] = rng.standard_normal(array[later].shape).astype(array.dtype)
        changed[name] = array
    changed["by"] = drive.by.copy()
    changed["by"][later] = NOISE
    traces = [
        {**trace, "objects": "forklift left 9 m", "plan": "stop now"} if trace["k"] > k else trace
        for trace in drive.traces
    ]
    return dataclasses.replace(drive, about=dataclasses.replace(drive.about, traces=tuple(traces)), **changed)


class SpoiledTokens:
    """Tokens whose frames after k are others."""

    def __init__(self, k: int) -> None:
        self._tokens = TOKENS.frames("").copy()
        self._tokens[k + 1 :] = 7.0

    def frames(self, drive_id: str) -> np.ndarray:
        return self._tokens


@pytest.mark.slow
def test_nothing_after_the_frame_reaches_the_inputs_of_its_sample(tmp_path: Path) -> None:
    network, k = build(tiny_model(), 1), 64
    config = SampleConfig(cut_text=0.5)

    def inputs(drive: Drive, tokens: MadeUpTokens | SpoiledTokens, folder: Path) -> list[Group]:
        dataset = write_dataset(folder / "collect", [drive])
        states = build_kv_cache(
            folder / "kv", network, NANO_TOKENIZER.read_bytes(), dataset, tokens, KvConfig(), seed=3
        )
        drives = [DriveFrames.of(drive, 30, config.weights)]
        samples = Samples(drives, tokens, states, TEN_S, config, tiny_model())
        choices = [SampleChoice(0, anchor, (k,) * 3, (k - anchor,) * 3) for anchor in (0, 30, 60)]
        return [samples.take(choice, np.random.default_rng(choice.anchor)) for choice in choices]

    drive = side_drive("left-a")
    before = inputs(drive, TOKENS, tmp_path / "true")
    after = inputs(spoiled(drive, k), SpoiledTokens(k), tmp_path / "spoiled")
    given = [field for field in dataclasses.fields(Group) if field.name != "around"]  # no policy is given walls
    for true, other in zip(before, after, strict=True):
        for field in given:
            # States are made in batches of other lengths, which rounds otherwise.
            close = 4e-3 if field.name == "guidance" else 0.0
            np.testing.assert_allclose(
                getattr(true, field.name), getattr(other, field.name), rtol=0, atol=close, err_msg=field.name
            )


def test_headings_of_a_label_are_not_wrapped() -> None:
    drive = side_drive("left-a")
    turned = np.linspace(0.1, 5.0, 50)
    future = drive.future.copy()
    future[:, :, 2] = (turned + np.pi) % (2 * np.pi) - np.pi
    frames = DriveFrames.of(dataclasses.replace(drive, future=future), 50, EVEN)
    np.testing.assert_allclose(frames.target[3, :, 2], turned, atol=1e-5)


def chance_of_frames(samples: Samples, count: int) -> np.ndarray:
    """How often each frame of the first drive is drawn."""
    seen = np.zeros(FRAMES)
    for number in range(count):
        chosen = samples.choose(np.random.default_rng((4, number)))
        if chosen.drive == 0:
            np.add.at(seen, list(chosen.ks), 1)
    return seen / seen.sum()


@pytest.mark.slow
def test_every_frame_with_a_label_is_drawn_equally_often_at_every_age(dataset: Dataset) -> None:
    samples = of(dataset, SampleConfig(group=8, standing_start=0.5, weights=EVEN))
    seen = chance_of_frames(samples, 4000)
    known = samples.drives[0].known >= LEAST_KNOWN
    assert not seen[~known].any()
    assert seen[known].min() > 0.6 / known.sum() and seen[known].max() < 1.5 / known.sum()
    parts = [seen[:40].sum(), seen[40:80].sum(), seen[80:120].sum()]
    assert parts == pytest.approx([40 / known.sum()] * 2 + [known[80:120].sum() / known.sum()], rel=0.12)


def test_frames_near_turns_goals_and_people_are_drawn_more_often(tmp_path: Path) -> None:
    drive = side_drive("left-a")
    traces = [{**trace, "motion": "person ahead 2 m coming"} if trace["k"] == 30 else trace for trace in drive.traces]
    by = drive.by.copy()
    by[20] = NOISE
    drive = dataclasses.replace(drive, about=dataclasses.replace(drive.about, traces=tuple(traces)), by=by)
    config = WeightConfig(turn=2.0, people=3.0, goal=5.0, goal_m=1.5, recovery=7.0, policy=11.0)
    weight = DriveFrames.of(drive, 30, config).weight
    # The turn is from frame 61 to 90: half a radian of it is within 3 s from frame 41 on.
    assert weight[25] == 1.0 and weight[20] == 7.0 and weight[0] == 7.0 and weight[21] == 1.0
    assert weight[30] == 3.0 and weight[39] == 3.0 and weight[42] == 2.0 and weight[70] == 2.0
    left = np.hypot(*(drive.pose[:, :2] - drive.about.goal_xy).T)
    near = (left < 1.5) & (drive.future_steps >= LEAST_KNOWN)
    assert near.any() and set(weight[near]) == {5.0}
    assert not weight[drive.future_steps < LEAST_KNOWN].any()
    policys = dataclasses.replace(drive, about=dataclasses.replace(drive.about, driver="policy:abc"))
    np.testing.assert_allclose(DriveFrames.of(policys, 30, config).weight, 11.0 * weight)


def test_frames_of_a_robot_that_stands_against_its_label_are_drawn_more_often() -> None:
    drive = side_drive("left-a")
    state, future = drive.state.copy(), drive.future.copy()
    state[:], future[:] = (0.5, 0.0, 0.0), 0.0
    state[20:50] = 0.0
    future[25:, :, 0] = np.linspace(0.0, 1.0, 50)
    future[40:, :, 0] = 0.0
    future[45, :, 2] = np.linspace(0.0, 1.5, 50)
    weight = DriveFrames.of(
        dataclasses.replace(drive, state=state, future=future, future_steps=np.full_like(drive.future_steps, 50)),
        30, dataclasses.replace(EVEN, stuck=4.0),
    ).weight  # fmt: skip
    # It stands from frame 20 on, so for a second from frame 30 on; it is led on until 40, and turned on the spot at 45.
    assert set(np.flatnonzero(weight == 4.0)) == {*range(30, 40), 45} and set(weight) == {1.0, 4.0}


@pytest.mark.slow
def test_a_robot_that_stands_in_its_first_frame_has_stood_there_before(dataset: Dataset) -> None:
    samples = of(dataset, dataclasses.replace(PLAIN, standing_start=1.0))
    stood = 0
    for chosen, group in drawn(samples, 200):
        drive = samples.drives[chosen.drive]
        for k, age, latency in zip(chosen.ks, chosen.ages, group.latency, strict=True):
            assert latency[0] == np.float32(age / 10) and 0 <= age <= 100
            np.testing.assert_allclose(latency[1:], drive.offset(chosen.anchor, k).as_tuple(), atol=1e-6)
            if age != k - chosen.anchor:
                assert chosen.anchor == 0 and age > k
                stood += 1
    assert stood > 50


def test_a_robot_that_moves_in_its_first_frame_keeps_its_age(tmp_path: Path) -> None:
    dataset = write_dataset(tmp_path, [side_drive("left-a", start_mps=0.5)])
    samples = of(dataset, dataclasses.replace(PLAIN, standing_start=1.0))
    for chosen, _ in drawn(samples, 100):
        assert all(age == k - chosen.anchor for k, age in zip(chosen.ks, chosen.ages, strict=True))


def test_without_injected_delay_every_state_is_of_its_frame(dataset: Dataset) -> None:
    samples = of(dataset, SampleConfig(group=4), Delays.none())
    assert samples.group == 1
    for chosen, group in drawn(samples, 50):
        assert chosen.ks == (chosen.anchor,) and chosen.ages == (0,)
        assert np.abs(group.latency).max() < 1e-12


@pytest.mark.slow
def test_tokens_and_states_are_dropped_at_the_networks_rates(dataset: Dataset) -> None:
    found = drawn(of(dataset, drop=True), 400)
    kept = np.concatenate([group.keep_guidance.ravel() for _, group in found])
    states = np.concatenate([group.keep_state for _, group in found])
    assert kept.mean() == pytest.approx(0.9, abs=0.03) and states.mean() == pytest.approx(0.5, abs=0.05)
    for _, group in drawn(of(dataset), 10):
        assert group.keep_guidance.all() and group.keep_state.all()


@pytest.mark.slow
def test_some_samples_are_blind_and_all_others_see_their_frame(dataset: Dataset) -> None:
    config = dataclasses.replace(PLAIN, blind=0.3)
    plain, some = of(dataset), of(dataset, config)
    hidden = []
    for chosen, group in drawn(some, 300):
        whole = TOKENS.frames(some.drives[chosen.drive].id)
        for k, seen in zip(chosen.ks, group.visual_tokens, strict=True):
            hidden.append(not seen.any())
            assert hidden[-1] or np.array_equal(seen, whole[k])
    assert np.mean(hidden) == pytest.approx(0.3, abs=0.05)
    assert all(group.visual_tokens.any(axis=(1, 2)).all() for _, group in drawn(plain, 50))
    assert config.undisturbed() == PLAIN


@pytest.mark.slow
def test_odometry_noise_grows_with_the_way_and_leaves_the_age(dataset: Dataset) -> None:
    samples = of(dataset, dataclasses.replace(PLAIN, offset_noise_m_per_m=0.05, offset_noise_deg_per_m=3.0))
    by_way: dict[bool, list[float]] = {False: [], True: []}
    for chosen, group in drawn(samples, 400):
        drive = samples.drives[chosen.drive]
        for k, age, latency in zip(chosen.ks, chosen.ages, group.latency, strict=True):
            assert latency[0] == np.float32(age / 10)
            error = np.hypot(*(latency[1:3] - drive.offset(chosen.anchor, k).as_tuple()[:2]))
            way_m = drive.way_m[k] - drive.way_m[chosen.anchor]
            if way_m == 0:
                assert error < 1e-6
            else:
                by_way[way_m > 2.5].append(error / way_m)
    for errors in by_way.values():
        # Of two Gaussians: the mean distance is sqrt(pi / 2) deviations.
        assert np.mean(errors) == pytest.approx(0.05 * np.sqrt(np.pi / 2), rel=0.15)


def test_waypoints_that_guide_are_seen_from_each_frame(dataset: Dataset) -> None:
    samples = of(dataset, model=with_interface("waypoints"))
    for chosen, group in drawn(samples, 30):
        points = samples.waypoints_of(chosen)
        assert points is not None and group.guidance.shape == (len(chosen.ks), 3, 2)
        for k, guidance in zip(chosen.ks, group.guidance, strict=True):
            offset = samples.drives[chosen.drive].offset(chosen.anchor, k)
            np.testing.assert_allclose(guidance, waypoints_now(points, offset)[0], atol=1e-6)


def test_states_without_waypoints_cannot_guide_by_them(dataset: Dataset) -> None:
    class Silent(SideStates):
        def at(self, drive_id: str, k: int, draw: int = 0) -> CachedState:
            state = super().at(drive_id, k, draw)
            return dataclasses.replace(state, text="Plan: go.") if k % 20 else state

    samples = of(dataset, model=with_interface("waypoints"), states=Silent(dataset))
    assert {chosen.anchor % 20 for chosen, _ in drawn(samples, 60)} == {0}


def test_a_data_set_without_frames_is_refused(tmp_path: Path, dataset: Dataset) -> None:
    class Nobody(SideStates):
        def anchors(self, drive_id: str) -> tuple[int, ...]:
            return ()

    with pytest.raises(SampleError, match="no frame"):
        of(dataset, states=Nobody(dataset))
    late = Delays.uniform(DelayConfig(low_s=40.0, high_s=50.0))
    with pytest.raises(SampleError, match="no frame"):
        of(dataset, delays=late)
    with pytest.raises(TrainError, match="10 to 50"):
        DriveFrames.of(dataset.load("left-a", pictures=False), 51, EVEN)


def test_a_label_that_backs_off_becomes_a_turn_on_the_spot() -> None:
    drive = side_drive("left-a")
    future = drive.future.copy()
    future[7] = np.arange(1, 51)[:, None] * np.array((-0.02, -0.005, 0.04))
    future[8] = np.arange(1, 51)[:, None] * np.array((0.05, 0.0, 0.0))
    target = DriveFrames.of(dataclasses.replace(drive, future=future), 30, EVEN).target
    assert not target[7, :, :2].any() and target[7, 9, 2] == pytest.approx(0.4)
    np.testing.assert_allclose(target[8], future[8, :30])
    command = arc_to(SE2(*map(float, target[7, 9])), 1.0)
    assert command[0] == 0.0 and command[1] == pytest.approx(0.4)


# -- delays: of the paper, or those that a device's runner acts on ---------------------------------------------------


def test_the_papers_delays_are_uniform_from_0_to_10_s() -> None:
    mass = Delays.of(DelayConfig()).mass
    assert len(mass) == 101
    np.testing.assert_allclose(mass[1:100], 0.01)
    # Half of what rounds to 0.0 s would be below 0, half of what rounds to 10.0 s beyond 10.
    assert mass[0] == pytest.approx(0.005) and mass[100] == pytest.approx(0.005)
    assert Delays.of(DelayConfig()).mean_s == pytest.approx(5.0)


def test_a_share_of_the_ages_can_be_near_without_the_others_going() -> None:
    config = DelayConfig(near_share=0.6, near_s=4.0)
    mass = Delays.of(config).mass
    np.testing.assert_allclose(mass[1:40], 0.4 * 0.01 + 0.6 * 0.025)
    np.testing.assert_allclose(mass[41:100], 0.4 * 0.01)
    assert Delays.of(config).mean_s == pytest.approx(0.4 * 5.0 + 0.6 * 2.0)


@pytest.mark.parametrize("seconds", [0.4, 2.0, 7.0])
def test_generations_that_all_take_as_long_are_between_one_and_two_of_their_times_old(seconds: float) -> None:
    delays = Delays.of_profile(LatencyProfile.constant(seconds))
    tenths = round(10 * seconds)
    assert set(np.flatnonzero(delays.mass)) == set(range(tenths, 2 * tenths + 1))
    np.testing.assert_allclose(delays.mass[tenths + 1 : 2 * tenths], 0.1 / seconds)
    assert delays.mean_s == pytest.approx(1.5 * seconds)


@pytest.mark.parametrize("late_anchor", [False, True])
def test_a_profiles_ages_are_those_that_a_run_with_its_times_has(late_anchor: bool) -> None:
    rng = np.random.default_rng(1)
    times = rng.gamma(4.0, 0.5, 60).clip(0.3, 8.0)
    anchors = 0.4 * times if late_anchor else 0.0 * times
    profile = LatencyProfile("p", "drawn", tuple(times), tuple(anchors))
    # The runner: a generation starts when the one before it is released, and is acted on until its own successor is.
    taken = rng.integers(len(times), size=40_000)
    released = np.cumsum(times[taken])
    anchored = released - times[taken] + anchors[taken]
    ticks = np.arange(released[0], released[-1], 0.1)
    ages = ticks - anchored[np.searchsorted(released, ticks, side="right") - 1]
    seen = np.bincount(np.round(10 * ages).astype(int)) / len(ticks)
    mass = Delays.of_profile(profile).mass
    longest = max(len(seen), len(mass))
    difference = np.pad(seen, (0, longest - len(seen))) - np.pad(mass, (0, longest - len(mass)))
    assert np.abs(np.cumsum(difference)).max() < 0.01


def test_a_profile_of_no_time_at_all_is_no_delay() -> None:
    assert Delays.of_profile(LatencyProfile.constant(0.0)).mass.tolist() == [1.0]
    assert Delays.none().mean_s == 0.0 and Delays.none().beyond.tolist() == [0.0]


def test_a_profile_is_read_from_the_file_that_the_recipe_names(tmp_path: Path) -> None:
    path = tmp_path / "orin.json"
    path.write_text(json.dumps(LatencyProfile.constant(2.0).as_json()))
    np.testing.assert_allclose(
        Delays.of(DelayConfig(profile=str(path))).mass, Delays.of_profile(LatencyProfile.constant(2.0)).mass
    )
    with pytest.raises(LatencyError, match="cannot be read"):
        Delays.of(DelayConfig(profile=str(tmp_path / "none.json")))
