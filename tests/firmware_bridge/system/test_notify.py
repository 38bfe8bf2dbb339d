"""The messages of a service to systemd, and that sending them can neither block nor fail."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_bridge.system.notify import MAX_STATUS_CHARS, Notifier
from tests.support.notify_socket import NotifySocket, notify_socket


@pytest.fixture
def manager(tmp_path: Path) -> Iterator[NotifySocket]:
    with notify_socket(tmp_path / "notify") as listening:
        yield listening


def test_every_message_is_one_datagram_as_systemd_reads_it(manager: NotifySocket) -> None:
    notifier = Notifier(manager.environment())
    assert notifier.extend(30)
    assert notifier.ready("armed")
    assert notifier.status("10 Hz")
    assert notifier.watchdog()
    assert notifier.stopping("asked to")
    assert manager.messages() == [
        {"EXTEND_TIMEOUT_USEC": "30000000"},
        {"READY": "1", "STATUS": "armed"},
        {"STATUS": "10 Hz"},
        {"WATCHDOG": "1"},
        {"STOPPING": "1", "STATUS": "asked to"},
    ]


def test_a_socket_in_the_abstract_namespace_is_reached(tmp_path: Path) -> None:
    with notify_socket(f"@tic-vla-edge-test-{os.getpid()}") as manager:
        assert Notifier(manager.environment()).watchdog()
        assert manager.messages() == [{"WATCHDOG": "1"}]


def test_outside_a_service_nothing_is_sent() -> None:
    notifier = Notifier({})
    assert not notifier.enabled
    assert notifier.watchdog_period_ns is None
    assert not notifier.ready("up")
    assert not notifier.watchdog()


@pytest.mark.parametrize("address", ["", "/", "relative", "vsock:2:1234", "/nowhere/notify", "/\0", "/" + 200 * "x"])
def test_an_address_that_cannot_be_used_raises_nothing(address: str) -> None:
    assert not Notifier({"NOTIFY_SOCKET": address}).ready("up")


def test_a_manager_that_does_not_read_costs_messages_and_no_time(manager: NotifySocket) -> None:
    notifier = Notifier(manager.environment())
    # A blocking send would hang here for ever: nobody reads until the queue has overflowed.
    sent = [notifier.watchdog() for _ in range(5000)]
    assert not all(sent)
    assert len(manager.messages()) == sum(sent)
    assert notifier.watchdog()


def test_a_manager_that_comes_back_gets_messages_again_until_the_end(tmp_path: Path) -> None:
    path = tmp_path / "notify"
    with notify_socket(path) as manager:
        notifier = Notifier(manager.environment())
    path.unlink()
    assert not notifier.watchdog()
    with notify_socket(path) as manager:
        assert notifier.watchdog()
        assert manager.messages() == [{"WATCHDOG": "1"}]
        for _ in range(2):
            notifier.close()
        assert not notifier.status("late")
        assert manager.messages() == []


@pytest.mark.parametrize(
    ("pid", "period_ns"), [(os.getpid(), 500_000_000), (os.getpid() + 1, None)], ids=["own", "other"]
)
def test_the_watchdog_is_due_at_half_its_time_if_it_is_meant_for_this_process(
    manager: NotifySocket, pid: int, period_ns: int | None
) -> None:
    assert Notifier(manager.environment(watchdog_us=1_000_000, pid=pid)).watchdog_period_ns == period_ns


@pytest.mark.parametrize("text", ["", "0", "-5", "1e6", "½", "9" * 40])
def test_a_watchdog_time_that_is_no_time_is_none(manager: NotifySocket, text: str) -> None:
    assert Notifier({**manager.environment(), "WATCHDOG_USEC": text}).watchdog_period_ns is None


@given(st.text(max_size=2 * MAX_STATUS_CHARS))
def test_a_status_can_smuggle_no_second_assignment(text: str) -> None:
    name = f"@tic-vla-edge-fuzz-{os.getpid()}"
    with notify_socket(name) as manager:
        assert Notifier({"NOTIFY_SOCKET": name}).status(text)
        (message,) = manager.messages()
    assert set(message) == {"STATUS"}
    assert len(message["STATUS"]) <= MAX_STATUS_CHARS
