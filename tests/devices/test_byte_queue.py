"""The emulated instruments' memory, against a plain string of bytes."""

from __future__ import annotations

import hypothesis.strategies as st
from hypothesis import given

from devices.emulation.timetag import ByteQueue
from devices.source import as_bytes

MOVES = st.lists(st.one_of(st.binary(max_size=20), st.integers(0, 30)), max_size=30)


@given(MOVES)
def test_it_is_a_queue(moves: list[bytes | int]) -> None:
    queue, model = ByteQueue(), b""
    for move in moves:
        if isinstance(move, bytes):
            queue.append(as_bytes(move))
            model += move
        else:
            buffer = bytearray(move)
            taken = queue.read_into(memoryview(buffer))
            assert bytes(buffer[:taken]) == model[:move]
            model = model[move:]
        assert len(queue) == len(model)
    queue.clear()
    assert len(queue) == queue.read_into(memoryview(bytearray(5))) == 0
