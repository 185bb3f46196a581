"""The accounts of a source, written to from several threads."""

from __future__ import annotations

import dataclasses
import threading
import time
from typing import Any

import pytest

from devices.source import Ledger, Stats


def test_every_change_moves_records_between_accounts() -> None:
    ledger = Ledger()
    ledger.receive(10)
    ledger.deliver(4, 1)
    ledger.drop(2)
    ledger.truncate()
    ledger.lose(5)
    ledger.time_out()
    ledger.reconnect()
    assert ledger.stats == Stats(
        acquired=16,
        delivered=4,
        dropped_host=2,
        lost_device=5,
        malformed=2,
        unread=3,
        timeouts=1,
        reconnects=1,
    )
    assert ledger.stats.is_balanced


def test_changes_at_the_same_time_all_count(monkeypatch: pytest.MonkeyPatch) -> None:
    """Another thread gets its turn between reading the accounts and writing them."""

    def replace_slowly(stats: Stats, **changes: Any) -> Stats:
        time.sleep(1e-3)
        return dataclasses.replace(stats, **changes)

    monkeypatch.setattr("devices.source.replace", replace_slowly)
    ledger = Ledger()
    started = threading.Barrier(4)

    def enter() -> None:
        started.wait()
        for _ in range(5):
            ledger.receive(1)

    threads = [threading.Thread(target=enter) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert ledger.stats.acquired == ledger.stats.unread == 20
