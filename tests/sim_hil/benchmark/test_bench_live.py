"""The addresses of the live view that `edge-bench --live` prints."""

from __future__ import annotations

import argparse

import pytest

from edge.live import options
from sim_hil.benchmark import run_command


@pytest.mark.parametrize(("address", "hosts"), [("0.0.0.0", ["127.0.0.1", "192.0.2.7"]), ("127.0.0.1", ["127.0.0.1"])])
def test_the_benchmark_prints_an_address_for_every_computer_that_may_watch(
    address: str, hosts: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(options, "_own_address", lambda *_: "192.0.2.7")
    args = argparse.Namespace(live=8765, live_address=address, live_token=None)
    with run_command._live_view(args, "realtime") as live:
        assert live is not None
        token = live.token()
    lines = capsys.readouterr().err.splitlines()
    assert [line.rpartition(" ")[2] for line in lines] == [f"http://{host}:8765/?token={token}" for host in hosts]
