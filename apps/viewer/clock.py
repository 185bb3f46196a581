"""Playback: which frame is due at what time."""

from __future__ import annotations

from dataclasses import dataclass, field

from tofclip.errors import InputError

MIN_SPEED, MAX_SPEED = 1 / 16, 16.0


@dataclass
class PlaybackClock:
    """Counts frames while it runs; the caller gives the time, in seconds of any steady clock, the
    `oldest` frame that still exists, and the `count` of frames, one after the last.
    """

    rate: float  # frames per second at speed 1
    speed: float = 1.0  # times faster than that
    # whether the last frame is followed by the first; otherwise the clock stops there
    loop: bool = True
    position: float = 0.0  # frame, and how far it has run
    playing: bool = field(default=False, init=False)
    _last_tick_s: float | None = field(default=None, init=False, repr=False)

    def __post_init__(self) -> None:
        if not self.rate > 0:
            raise InputError(f"frames per second must be positive, got {self.rate}")

    @property
    def frame(self) -> int:
        """The frame that is due."""
        return int(self.position)

    def play(self, oldest: int, count: int) -> None:
        """Run; from the oldest frame on where the last one is reached."""
        if self.frame >= count - 1:
            self.position = float(oldest)
        self.playing, self._last_tick_s = True, None

    def pause(self) -> None:
        """Stand still."""
        self.playing = False

    def jump(self, frame: int, oldest: int, count: int) -> None:
        """Go to a frame, or to the nearest that exists."""
        self.position = float(min(max(frame, oldest), max(count - 1, oldest)))
        self._last_tick_s = None

    def step(self, frames: int, oldest: int, count: int) -> None:
        """Pause, and move by a number of frames, back where it is negative."""
        self.pause()
        self.jump(self.frame + frames, oldest, count)

    def set_speed(self, speed: float) -> None:
        """Run faster or slower from now on, within bounds."""
        self.speed = min(max(speed, MIN_SPEED), MAX_SPEED)

    def tick(self, now: float, oldest: int, count: int) -> int:
        """Let time pass and return the frame that is due."""
        # a clock of the machine may be set back
        passed = 0.0 if self._last_tick_s is None else max(0.0, now - self._last_tick_s)
        self._last_tick_s = now
        if self.playing and count > oldest:
            self._advance(passed * self.rate * self.speed, oldest, count)
        if self.frame < oldest:  # forgotten meanwhile
            self.position = float(oldest)
        return self.frame

    def _advance(self, frames: float, oldest: int, count: int) -> None:
        self.position += frames
        if self.position < count:
            return
        if self.loop:
            # The remainder is kept, so that a loop runs as fast as the frames do.
            self.position = oldest + (self.position - oldest) % (count - oldest)
        else:
            self.position = float(count - 1)
            self.pause()
