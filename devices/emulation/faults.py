"""Faults to order: what goes wrong, and in which transfer."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from tofclip.errors import InputError

FaultKind = Literal[
    "timeout",
    "stall",
    "unplug",
    "powerloss",
    "short",
    "overflow",
    "corrupt",
    "lost",
    "reply_late",
    "reply_lost",
    "reply_stall",
]
FAULT_KINDS: tuple[FaultKind, ...] = get_args(FaultKind)
REPLY_FAULTS = ("reply_late", "reply_lost", "reply_stall")

PERMANENT_ENUMERATIONS = 1_000_000
"""Enumerations after which nothing looks any more."""


@dataclass(frozen=True)
class Fault:
    """One fault."""

    # number of the data transfer in which it happens, from 0 since the instrument was first
    # started, without those by which old data is thrown away; or of the reply, from 0 since it was
    # switched on
    transfer: int
    # ``timeout``: nothing comes. ``stall``: the endpoint halts, `amount` times in a row.
    # ``unplug``: gone for `amount` enumerations, keeping its power; ``powerloss``: without.
    # ``short``: only `amount` bytes come now. ``overflow``: the transfer is lost on the wire.
    # ``corrupt``: `amount` records cannot be. ``lost``: `amount` records find the instrument's
    # memory full. ``reply_late``: a reply comes only after the host has given up. ``reply_lost``:
    # it never comes. ``reply_stall``: its endpoint halts once
    kind: FaultKind
    amount: int = 1

    @classmethod
    def parse(cls, text: str) -> tuple[Fault, ...]:
        """Read ``kind@transfer`` or ``kind@transfer:amount``, joined by commas."""
        return tuple(cls._parse_one(word) for word in text.split(",") if word)

    @classmethod
    def _parse_one(cls, word: str) -> Fault:
        kind, _, rest = word.partition("@")
        transfer, _, amount = rest.partition(":")
        known = next((known for known in FAULT_KINDS if known == kind), None)
        if known is None or not transfer.isdecimal() or not (amount or "1").isdecimal():
            raise InputError(
                f"'{word}' is not a fault; write KIND@TRANSFER:AMOUNT with one of {', '.join(FAULT_KINDS)}"
            )
        return cls(int(transfer), known, int(amount or 1))


def draw_fault_script(seed: int, transfers: int) -> tuple[Fault, ...]:
    """Draw up to six faults of any kind, at most one per transfer, within the first `transfers`.

    Returns in the order of the transfers.
    """
    rng = np.random.default_rng(seed)
    # without repeats: one fault for a transfer
    when = rng.permutation(transfers)[: rng.integers(0, 7)]
    return tuple(Fault(int(transfer), *_draw_fault(rng)) for transfer in sorted(when))


def _draw_fault(rng: np.random.Generator) -> tuple[FaultKind, int]:
    kind = FAULT_KINDS[rng.integers(len(FAULT_KINDS))]
    if kind in ("stall", "unplug", "powerloss"):
        often = int(rng.choice([1, 2], p=[0.85, 0.15]))
        if kind == "stall" or often == 1:
            return kind, often
        # Rarely the instrument never comes back.
        return kind, PERMANENT_ENUMERATIONS
    if kind in REPLY_FAULTS:
        return kind, int(rng.integers(1, 4))
    return kind, int(rng.integers(0, 600))
