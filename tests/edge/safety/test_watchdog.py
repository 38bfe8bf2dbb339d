"""Ticks on time feed the watchdog and nothing else does; a reasoning call that hangs is interrupted, then given up."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from pathlib import Path

import pytest

from edge.run.service import STATUS_PERIOD_NS, ServiceReporter
from edge.safety.watchdog import NEEDED_ON_TIME, WINDOW_TICKS, Hang, ReasoningWatch, WatchdogFeeder
from firmware_bridge.system.notify import Notifier
from tests.support.notify_socket import NotifySocket, notify_socket

TICK_NS = 100_000_000
PING_NS = 1_500_000_000


def feeder() -> WatchdogFeeder:
    return WatchdogFeeder(ping_period_ns=PING_NS, tick_period_ns=TICK_NS)


def pings(fed: WatchdogFeeder, ticks: list[bool], start: int = 0) -> list[int]:
    """Numbers of the ticks at which a ping was due."""
    return [start + n for n, on_time in enumerate(ticks) if fed.on_tick(on_time, (start + n) * TICK_NS)]


def test_two_late_ticks_in_ten_are_forgiven_and_three_are_not() -> None:
    late = WINDOW_TICKS - NEEDED_ON_TIME
    forgiven, not_forgiven = feeder(), feeder()
    assert pings(forgiven, [True] * NEEDED_ON_TIME + [False] * late)
    assert not pings(not_forgiven, [True] * (NEEDED_ON_TIME - 1) + [False] * (late + 1))


def test_deadlines_that_were_slept_over_are_ticks_that_were_not_on_time() -> None:
    fed = feeder()
    pings(fed, [True] * WINDOW_TICKS)
    fed.on_tick(True, (WINDOW_TICKS + 3) * TICK_NS)
    assert not fed.healthy


def test_jitter_below_half_a_period_is_no_missed_tick() -> None:
    fed = feeder()
    for n in range(3 * WINDOW_TICKS):
        fed.on_tick(True, n * TICK_NS + (n % 2) * (TICK_NS // 2 - 1))
    assert fed.healthy


def test_without_a_watchdog_no_ping_is_due() -> None:
    fed = WatchdogFeeder(ping_period_ns=None, tick_period_ns=TICK_NS)
    assert pings(fed, [True] * 100) == []
    assert fed.healthy


@pytest.mark.parametrize("periods", [(0, TICK_NS), (PING_NS, 0), (-1, TICK_NS)])
def test_periods_must_be_positive(periods: tuple[int, int]) -> None:
    with pytest.raises(ValueError, match="positive"):
        WatchdogFeeder(ping_period_ns=periods[0], tick_period_ns=periods[1])


class Service:
    """A reporter on a clock of the test's own, and systemd's end of its socket."""

    def __init__(self, manager: NotifySocket) -> None:
        self.manager = manager
        self.now_ns = 0
        self.reporter = ServiceReporter(
            Notifier(manager.environment(watchdog_us=2 * PING_NS // 1000)),
            tick_period_ns=TICK_NS,
            describe=lambda: f"at {self.now_ns // TICK_NS}",
            clock=lambda: self.now_ns,
        )

    def tick(self, count: int, *, on_time: bool = True) -> list[dict[str, str]]:
        for _ in range(count):
            self.reporter.on_tick(on_time)
            self.now_ns += TICK_NS
        return self.manager.messages()


@pytest.fixture
def service(tmp_path: Path) -> Iterator[Service]:
    with notify_socket(tmp_path / "notify") as manager:
        yield Service(manager)


def test_a_long_step_of_start_up_extends_the_timeout_and_names_itself(service: Service) -> None:
    service.reporter.starting("verifying artifacts", 60)
    assert service.manager.messages() == [{"EXTEND_TIMEOUT_USEC": "60000000"}, {"STATUS": "verifying artifacts"}]


def test_ready_is_sent_once_and_only_after_a_window_of_ticks_on_time(service: Service) -> None:
    assert service.tick(WINDOW_TICKS - 1) == []
    assert service.tick(1) == [{"READY": "1", "STATUS": "at 9"}]
    assert not any("READY" in message for message in service.tick(100))


def test_a_runner_that_is_never_on_time_is_never_ready(service: Service) -> None:
    assert service.tick(100, on_time=False) == []


def test_systemd_gets_a_ping_within_its_time_as_long_as_ticks_are_on_time(service: Service) -> None:
    service.tick(WINDOW_TICKS)
    pinged = [n for n in range(100) if {"WATCHDOG": "1"} in service.tick(1)]
    assert pinged[0] * TICK_NS <= PING_NS
    assert all((later - earlier) * TICK_NS <= PING_NS for earlier, later in itertools.pairwise(pinged))


def test_systemd_gets_no_ping_from_a_control_thread_that_is_late(service: Service) -> None:
    service.tick(2 * WINDOW_TICKS)
    service.tick(WINDOW_TICKS, on_time=False)
    assert {"WATCHDOG": "1"} not in service.tick(100, on_time=False)


def wait(service: Service, count: int, text: str = "waiting to be armed") -> list[dict[str, str]]:
    """Turns of the waiting loop, two in the time of a tick."""
    for _ in range(count):
        service.reporter.on_wait(text)
        service.now_ns += TICK_NS // 2
    return service.manager.messages()


def test_a_runner_that_waits_for_an_operator_is_ready_and_names_the_wait(service: Service) -> None:
    assert wait(service, 1) == [{"READY": "1", "STATUS": "waiting to be armed"}]
    assert not any("READY" in message for message in [*wait(service, 1000), *service.tick(100)])
    assert {"STATUS": "arming"} in wait(service, 3, "arming")


def test_waiting_feeds_the_watchdog_in_time_from_ready_until_ticks_do(service: Service) -> None:
    assert any("READY" in message for message in wait(service, 1))
    fed = [service.now_ns]
    for turn in (wait, lambda service, count: wait(service, count, "arming"), Service.tick):
        for _ in range(200):
            if {"WATCHDOG": "1"} in turn(service, 1):
                fed.append(service.now_ns)
        assert service.now_ns - fed[-1] <= PING_NS
    assert max(later - earlier for earlier, later in itertools.pairwise(fed)) <= 1.5 * PING_NS, "of 2, WatchdogSec"


def test_a_waiting_loop_that_stands_still_feeds_nothing(service: Service) -> None:
    wait(service, 100)
    service.now_ns += 10 * PING_NS
    assert service.manager.messages() == []


def test_the_status_line_is_renewed_without_flooding(service: Service) -> None:
    service.tick(WINDOW_TICKS)
    renewed = [message for message in service.tick(150) if set(message) == {"STATUS"}]
    assert len(renewed) == 150 * TICK_NS // STATUS_PERIOD_NS


def test_the_manager_is_notified_of_the_end(service: Service) -> None:
    service.reporter.stopping("asked to stop")
    assert service.manager.messages() == [{"STOPPING": "1", "STATUS": "asked to stop"}]


# --- the reasoning thread ---

S = 1_000_000_000
STEP_NS = S // 20


class ReasoningRun:
    """A watch and a reasoning thread that makes progress when the test says so."""

    def __init__(self, longest_ms: float | None = None) -> None:
        self.watch = ReasoningWatch()
        self.longest_ms = longest_ms
        self.now_ns = self.progress_ns = 100 * S
        self.found: list[tuple[float, Hang]] = []

    def hang(self, seconds: float) -> ReasoningRun:
        """The thread is in one call for so long; the watch steps 20 times a second."""
        for _ in range(round(seconds * S / STEP_NS)):
            self.now_ns += STEP_NS
            hang = self.watch.step(self.progress_ns, self.longest_ms, self.now_ns)
            if hang is not Hang.NONE:
                self.found.append((round((self.now_ns - self.progress_ns) / S), hang))
        return self

    def goes_on(self) -> None:
        self.progress_ns = self.now_ns


def test_a_call_that_takes_ten_seconds_is_interrupted_once() -> None:
    assert ReasoningRun().hang(25).found == [(10, Hang.INTERRUPT)]


def test_a_call_that_an_interrupt_does_not_end_is_given_up() -> None:
    found = ReasoningRun().hang(31).found
    assert found[:2] == [(10, Hang.INTERRUPT), (30, Hang.GIVE_UP)]


def test_after_an_interrupt_that_helped_the_next_hang_is_interrupted_again() -> None:
    run = ReasoningRun().hang(12)
    run.goes_on()
    run.hang(12)
    assert [hang for _, hang in run.found] == [Hang.INTERRUPT, Hang.INTERRUPT]


def test_calls_that_end_are_left_alone_however_many_there_are() -> None:
    run = ReasoningRun()
    for _ in range(20):
        run.hang(9)
        run.goes_on()
    assert run.found == []


def test_where_generations_take_long_a_call_may_too() -> None:
    assert ReasoningRun(longest_ms=8_000).hang(23).found == []
    assert ReasoningRun(longest_ms=8_000).hang(25).found == [(24, Hang.INTERRUPT)]


def test_a_process_that_was_frozen_has_not_hung() -> None:
    run = ReasoningRun().hang(1)
    run.now_ns += 3600 * S
    assert run.hang(1).found == []
