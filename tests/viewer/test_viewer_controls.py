"""What a user types is taken, whatever the viewer shows meanwhile."""

from __future__ import annotations

import asyncio
import inspect
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

from apps.viewer.panels import bind_user_input


class Slider:
    """As viser's: it calls coroutines at once, and functions from a thread of its own, later."""

    def __init__(self) -> None:
        self.value = 0
        self.later: list[Callable[[], Any]] = []

    def on_update(self, callback: Callable[[Any], Any]) -> None:
        self._callback = callback

    def type(self, value: int) -> None:
        self.value = value
        event = SimpleNamespace(client=object(), target=self)
        if inspect.iscoroutinefunction(self._callback):
            asyncio.run(self._callback(event))
        else:
            self.later.append(lambda: self._callback(event))


def test_a_number_that_was_typed_outlives_the_frame_that_is_being_shown() -> None:
    slider, commands, jumps = Slider(), [], []
    bind_user_input(slider, commands.append, jumps.append)
    slider.type(10)
    slider.value = 0  # the frame that the viewer was drawing, which its control then says
    for call in slider.later:
        call()
    for command in commands:
        command()
    assert jumps == [10]
