"""The page's own pieces of HTML: where one is, and what the colours mean. Names of files are
escaped.
"""

from __future__ import annotations

import html
from dataclasses import dataclass, field

import numpy as np

from apps.viewer.colouring import PALETTE_SIZE, Scale, choose_ticks, load_palette
from apps.viewer.source import Inflow
from tofclip.units import NANOSECOND, SPEED_OF_LIGHT

GRADIENT_STOPS, LABEL_MARGIN = 24, 0.04
HTML_STYLE = "padding:0.2em 0.8em 0.6em;font-size:0.85em;line-height:1.5"
LINE_STYLE = (
    "white-space:nowrap;overflow:hidden;text-overflow:ellipsis;font-variant-numeric:tabular-nums"
)

# The page dims its panels and takes no clicks while its connection is down; the words in them are
# shown by that very style, which needs no script.
LOST_STYLE = """
.tofclip-lost {display: none}
div[style*="pointer-events: none"] .tofclip-lost {
  display: block; position: fixed; z-index: 1000; top: 1em; left: 50%; transform: translateX(-50%);
  padding: 0.8em 1.2em; border-radius: 0.4em; background: #e5484d; color: white; font-size: 1.1em}
"""
LOST_TEXT = (
    "Connection lost: tofclip view has ended, or cannot be reached. What you see is the last "
    "picture. This page goes on by itself once it reaches the program again; a new tofclip view has "
    "a new address."
)
SHARED_TEXT = (
    "Every browser at this address shows the same frame, colours, filters and picked points; where "
    "you look from is your own."
)
BLANK_PIXEL = "data:image/gif;base64,R0lGODlhAQABAIAAAAAAAP///yH5BAEAAAAALAAAAAABAAEAAAIBRAA7"


@dataclass(frozen=True)
class Status:
    """What the line at the top says."""

    label: str  # ``"LIVE"`` or ``"REPLAY"``
    frame: int
    frames: int
    points: int
    frame_rate: float  # frames per second that are sent to the page
    inflow: Inflow = field(default_factory=Inflow)
    time: float = float("nan")  # time of flight of the frame, s; NaN where frames have none
    frame_name: str = "frame"  # what a frame is: frame, slice, shot or cloud
    depth_text: str = ""  # where a slice lies; empty where frames are not slices
    # what has to be known about the picture, such as that its ranges have no time zero
    notes: tuple[str, ...] = ()
    # what is shown where it is not one frame but all of them, instead of the frame's number
    whole_name: str = ""
    # of a large cloud, by a browser that would be slow with all of them
    drawn_points: int | None = None

    @property
    def html(self) -> str:
        """Its lines, with ids for scripts. Each is as high whatever it says, so that nothing below
        moves while frames pass.
        """
        colour = "#e5484d" if self.label == "LIVE" else "#3e8ed0"
        what = html.escape(self.whole_name or self.frame_name)
        if not self.whole_name and (self.frames > 1 or self.label == "LIVE"):
            what += f" <b id='frame-number'>{self.frame}</b> of {self.frames}"
        lines = [
            f"<b id='label' style='color:{colour}'>{self.label}</b> <span id='what'>{what}</span>"
        ]
        if np.isfinite(self.time):
            distance = SPEED_OF_LIGHT * self.time / 2
            lines.append(
                f"<span id='instant'>{self.time / NANOSECOND:.2f} ns, range {distance:.3f} m</span>"
            )
        if self.depth_text:
            lines.append(f"<span id='depth'>{html.escape(self.depth_text)}</span>")
        drawn = self.points if self.drawn_points is None else self.drawn_points
        part = f" ({drawn} drawn)" if drawn < self.points else ""
        lines.append(f"<span id='points'>{self.points}</span> points{part}")
        if self.frames > 1 or self.label == "LIVE":
            coming = f"data {self.inflow.data_rate:.1f}/s, " if self.inflow.data_rate > 0 else ""
            shown_words = (
                f"shown {self.frame_rate:.1f}/s" if self.frame_rate > 0 else "standing still"
            )
            lines.append(f"<span id='rates'>{coming}{shown_words}</span>")
        if self.label == "LIVE" or np.isfinite(self.inflow.latency):
            delay = (
                f"{1e3 * self.inflow.latency:.0f} ms"
                if np.isfinite(self.inflow.latency)
                else "not known yet"
            )
            lines.append(f"shot to cloud {delay}, {self.inflow.lost} dropped")
        shown = "".join(f"<div style='{LINE_STYLE}'>{line}</div>" for line in lines)
        shown += "".join(
            f"<div class='note' style='color:#ffb020'>{html.escape(note)}</div>"
            for note in self.notes
        )
        trouble = (
            f"<div style='color:#e5484d'>{html.escape(self.inflow.failure_text)}</div>"
            if self.inflow.failure_text
            else ""
        )
        return f"<div style='{HTML_STYLE}'>{shown}{trouble}</div>"


def render_scale_html(scale: Scale) -> str:
    """Return the colours in a row, with the values of some of them below."""
    colours = load_palette(scale.palette)[
        np.linspace(0, PALETTE_SIZE - 1, GRADIENT_STOPS).round().astype(int)
    ]
    stops = ",".join(f"rgb({red},{green},{blue})" for red, green, blue in colours.tolist())
    places, title = choose_ticks(scale)
    ticks = "".join(
        f"<span style='position:absolute;left:{100 * place:.1f}%;transform:translateX(-{_find_label_shift(place)}%)'>"
        f"{label}</span>"
        for place, label in places
    )
    return (
        f"<div id='scale' style='{HTML_STYLE}'>{title}"
        f"<div style='height:0.9em;background:linear-gradient(to right,{stops})'></div>"
        f"<div style='position:relative;height:1.5em'>{ticks}</div></div>"
    )


def _find_label_shift(place: float) -> int:
    """Share of a label's width by which it stands left of its place, %: at the ends it stays inside."""
    return 0 if place < LABEL_MARGIN else 100 if place > 1 - LABEL_MARGIN else 50


def render_page_html(title: str) -> str:
    """Return what is said at the foot of the controls, and what names the browser's tab.

    `title`: of the source.
    """
    name = html.escape(format_page_title(title), quote=True)
    # a picture's event is the one script that runs in a text put into a page
    tab = f'<img hidden src="{BLANK_PIXEL}" data-name="{name}" onload="document.title=this.dataset.name">'
    return (
        f"<style>{LOST_STYLE}</style>{tab}<div class='tofclip-lost'>{LOST_TEXT}</div>"
        f"<div id='shared' style='{HTML_STYLE};opacity:0.7'>{SHARED_TEXT}</div>"
    )


def render_waiting_html(words: str) -> str:
    """Return what is said while there is nothing to look at yet.

    `words`: what is being done.
    """
    return f"<div id='waiting' style='{HTML_STYLE}'>{html.escape(words)} ...</div>"


def format_page_title(title: str) -> str:
    """Return what stands above the controls."""
    return f"tofclip · {title}"[:60]
