"""The page's own pieces of HTML: where one is, and what the colours mean. Names of files are
escaped.
"""

from __future__ import annotations

import html
from dataclasses import dataclass

import numpy as np

from apps.viewer.colouring import PALETTE_SIZE, Scale, choose_ticks, load_palette
from tofclip.units import NANOSECOND, SPEED_OF_LIGHT

GRADIENT_STOPS = 24
HTML_STYLE = "padding:0.2em 0.8em 0.6em;font-size:0.85em;line-height:1.5"


@dataclass(frozen=True)
class Status:
    """What the line at the top says.

    Parameters
    ----------
    label : str
        ``"LIVE"`` or ``"REPLAY"``.
    frame, frames : int
    points : int
    data_rate, frame_rate : float
        Frames per second that come in, and that are sent to the page.
    cloud_latency : float
        From when a shot was taken until its cloud was there, s; NaN where none comes in.
    lost : int
        Shots that were taken and are not shown, wherever they were lost.
    failure_text : str
    time : float
        Time of flight of the frame, s; NaN where frames have none.
    """

    label: str
    frame: int
    frames: int
    points: int
    data_rate: float
    frame_rate: float
    cloud_latency: float = float("nan")
    lost: int = 0
    failure_text: str = ""
    time: float = float("nan")

    @property
    def html(self) -> str:
        """The line, with ids for scripts."""
        colour = "#e5484d" if self.label == "LIVE" else "#3e8ed0"
        lost = f", {self.lost} dropped" if self.lost else ""
        coming = (
            f"<br>shot to cloud {1e3 * self.cloud_latency:.0f} ms{lost}"
            if np.isfinite(self.cloud_latency)
            else ""
        )
        instant = (
            f"<br><span id='instant'>{self.time / NANOSECOND:.2f} ns, range "
            f"{SPEED_OF_LIGHT * self.time / 2:.3f} m</span>"
            if np.isfinite(self.time)
            else ""
        )
        trouble = (
            f"<div style='color:#e5484d'>{html.escape(self.failure_text)}</div>"
            if self.failure_text
            else ""
        )
        return (
            f"<div style='{HTML_STYLE}'><b id='label' style='color:{colour}'>{self.label}</b> "
            f"frame <b id='frame-number'>{self.frame}</b> of {self.frames}, <span id='points'>{self.points}</span> "
            f"points{instant}<br><span id='rates'>data {self.data_rate:.1f}/s, shown "
            f"{self.frame_rate:.1f}/s{coming}</span>{trouble}</div>"
        )


def render_scale_html(scale: Scale) -> str:
    """Return the colours in a row, with the values of some of them below."""
    colours = load_palette(scale.palette)[
        np.linspace(0, PALETTE_SIZE - 1, GRADIENT_STOPS).round().astype(int)
    ]
    stops = ",".join(f"rgb({red},{green},{blue})" for red, green, blue in colours.tolist())
    places, title = choose_ticks(scale)
    ticks = "".join(
        f"<span style='position:absolute;left:{100 * place:.1f}%;transform:translateX(-50%)'>{label}</span>"
        for place, label in places
    )
    return (
        f"<div id='scale' style='{HTML_STYLE}'>{title}"
        f"<div style='height:0.9em;background:linear-gradient(to right,{stops})'></div>"
        f"<div style='position:relative;height:1.5em'>{ticks}</div></div>"
    )


def format_page_title(title: str) -> str:
    """Return what stands above the controls."""
    return f"tofclip · {title}"[:60]
