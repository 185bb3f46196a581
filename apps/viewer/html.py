"""The texts of the page: what is shown, colours with their values, histograms, words at the foot."""

from __future__ import annotations

import html

import numpy as np

from apps.viewer.look import PALETTE_SIZE, Scale, choose_ticks, load_palette
from apps.viewer.session import DisplayedFrame, Session
from apps.viewer.source import Limits
from tofclip.arrays import AnyArray
from tofclip.units import NANOSECOND, SPEED_OF_LIGHT

GRADIENT_STOPS, LABEL_MARGIN = 24, 0.04
HANDLES_EM = 7.3  # where sliders begin, in widths of an m
TEXT_STYLE = "padding:0.2em 0.8em 0.6em;font-size:0.85em"
HTML_STYLE = f"{TEXT_STYLE};line-height:1.5"
LINE_STYLE = (
    "white-space:nowrap;overflow:hidden;text-overflow:ellipsis;font-variant-numeric:tabular-nums"
)
RED, BLUE, AMBER = "#e5484d", "#3e8ed0", "#ffb020"
# The page dims its panels and takes no clicks while its connection is down; the words in them are
# shown by that very style, which needs no script.
LOST_STYLE = """
.tofclip-lost {display: none}
.tofclip-notes {
  position: fixed; z-index: 5; pointer-events: none; bottom: 0.6em; left: 260px;
  max-width: calc(100vw - 640px); text-shadow: 0 0 4px black}
@media (max-width: 576px) {.tofclip-notes {position: static; max-width: none}}
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
# On a phone the panel lies over the scene: it begins folded, once.
FOLD_SCRIPT = (
    "if(innerWidth<576&&!window.tofclipFolded){window.tofclipFolded=1;"
    "[...document.querySelectorAll('[class*=Paper-root] div')].find("
    "e=>getComputedStyle(e).cursor=='pointer')?.click()}"
)
BLANK_PIXEL = "data:image/gif;base64,R0lGODlhAQABAIAAAAAAAP///yH5BAEAAAAALAAAAAABAAEAAAIBRAA7"


def render_status_html(
    session: Session, shown: DisplayedFrame, frame_rate: float, drawn: int | None = None
) -> str:
    """Return the lines at the top, with ids for scripts. Each is as high whatever it says, so that
    nothing below moves while frames pass. `frame_rate`: frames per second that are sent to the page;
    `drawn`: points that a browser gets that would be slow with all of them.
    """
    source, label, inflow = session.source, session.label, session.source.inflow
    is_live, frames = label == "LIVE", len(session.source)
    what = html.escape(shown.whole_name or source.frame_name)
    if not shown.whole_name and (frames > 1 or is_live):
        what += f" <b id='frame-number'>{shown.frame + 1}</b> of {frames}"
    colour = RED if is_live else BLUE
    lines = [f"<b id='label' style='color:{colour}'>{label}</b> <span id='what'>{what}</span>"]
    if np.isfinite(shown.time):
        instant = f"{shown.time / NANOSECOND:.2f} ns, range {SPEED_OF_LIGHT * shown.time / 2:.3f} m"
        lines.append(f"<span id='instant'>{instant}</span>")
    if shown.text:
        lines.append(f"<span id='depth'>{html.escape(shown.text)}</span>")
    part = f" ({drawn} drawn)" if drawn is not None and drawn < shown.points else ""
    lines.append(f"<span id='points'>{shown.points}</span> points{part}")
    if frames > 1 or is_live:
        coming = f"data {inflow.data_rate:.1f}/s, " if inflow.data_rate > 0 else ""
        rate = f"shown {frame_rate:.1f}/s" if frame_rate > 0 else "paused"
        lines.append(f"<span id='rates'>{coming}{rate}</span>")
    is_known = np.isfinite(inflow.latency)
    if is_live or is_known:
        delay = f"{1e3 * inflow.latency:.0f} ms" if is_known else "not known yet"
        lines.append(f"shot to cloud {delay}, {inflow.lost} dropped")
    parts = [f"<div style='{LINE_STYLE}'>{line}</div>" for line in lines]
    # over the scene: in the panel, a note that comes would push the controls down
    amber = f"<div class='note' style='color:{AMBER}'>"
    notes = [f"{amber}{html.escape(note)}</div>" for note in session.notes]
    if inflow.failure_text:
        notes.append(f"<div style='color:{RED}'>{html.escape(inflow.failure_text)}</div>")
    parts.append(f"<div class='tofclip-notes'>{''.join(notes)}</div>")
    return f"<div style='{HTML_STYLE}'>{''.join(parts)}</div>"


def render_scale_html(scale: Scale) -> str:
    """Return the colours in a row, with the values of some of them below."""
    stops = np.linspace(0, PALETTE_SIZE - 1, GRADIENT_STOPS).round().astype(int)
    colours = ",".join(
        f"rgb({r},{g},{b})" for r, g, b in load_palette(scale.palette)[stops].tolist()
    )
    places, title = choose_ticks(scale)
    ticks = ""
    for place, label in places:
        # at the ends a label stays inside
        shift = 0 if place < LABEL_MARGIN else 100 if place > 1 - LABEL_MARGIN else 50
        style = f"position:absolute;left:{100 * place:.1f}%;transform:translateX(-{shift}%)"
        ticks += f"<span style='{style}'>{label}</span>"
    return (
        f"<div id='scale' style='{HTML_STYLE}'>{title}"
        f"<div style='height:0.9em;background:linear-gradient(to right,{colours})'></div>"
        f"<div style='position:relative;height:1.5em'>{ticks}</div></div>"
    )


BAR_COUNT, OUTSIDE_COLOUR = 64, (70, 76, 88)


def render_histogram_html(
    values: AnyArray, span: Limits, limits: Limits, scale: Scale | None
) -> str:
    """Return bars in a scale's colours, grey beyond limits; square roots, so that few are seen."""
    counts, edges = np.histogram(values, BAR_COUNT, span)
    middles = (edges[1:] + edges[:-1]) / 2
    blue = np.full((BAR_COUNT, 3), (62, 142, 208), np.uint8)
    colours = blue if scale is None else scale.colours(middles)
    colours[(middles < limits[0]) | (middles > limits[1])] = OUTSIDE_COLOUR
    heights = 20 * np.sqrt(counts / max(1, counts.max()))
    bars = "".join(
        f"<rect x='{n}' y='{20 - height:.1f}' width='1.02' height='{height:.1f}' fill='rgb({r},{g},{b})'/>"
        for n, (height, (r, g, b)) in enumerate(zip(heights, colours.tolist(), strict=True))
        if height
    )
    return (
        f"<div style='padding:0 1.1em 0 {HANDLES_EM}em'><svg viewBox='0 0 {BAR_COUNT} 20' "
        f"preserveAspectRatio='none' style='width:100%;height:44px;display:block'>{bars}</svg></div>"
    )


def render_page_html(title: str) -> str:
    """Return what is said at the foot of the controls, and what names the browser's tab."""
    name = html.escape(format_page_title(title), quote=True)
    # a picture's event is the one script that runs in a text put into a page
    act = f"document.title=this.dataset.name;{FOLD_SCRIPT}"
    tab = f'<img hidden src="{BLANK_PIXEL}" data-name="{name}" onload="{act}">'
    return (
        f"<style>{LOST_STYLE}</style>{tab}<div class='tofclip-lost'>{LOST_TEXT}</div>"
        f"<div id='shared' style='{HTML_STYLE};opacity:0.7'>{SHARED_TEXT}</div>"
    )


def render_text_html(name: str, text: str) -> str:
    """Return a text of some lines, with an id for scripts."""
    lines = "<br>".join(html.escape(text).splitlines())
    return f"<div id='{name}' style='{TEXT_STYLE}'>{lines}</div>"


def format_page_title(title: str) -> str:
    """Return what stands above the controls."""
    return f"tofclip · {title}"[:60]
