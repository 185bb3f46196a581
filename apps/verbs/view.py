"""`tofclip view`: look at clouds, transients, hidden volumes, raw shots and instruments."""

from __future__ import annotations

import contextlib
import time
from dataclasses import asdict
from functools import partial
from pathlib import Path

from apps.options import NO_BROWSER, PICTURE_FORMATS, PORT, TIME_ZERO, arg, flag, opt
from apps.progress import show_activity, show_progress
from apps.report import report, require_writable
from tofclip.errors import InputError
from tofclip.files import PICTURE_SUFFIXES
from tofclip.plugins import METHODS


def view(
    source: list[str] = arg(
        "SOURCE...",
        "Frames, cloud, volume, raw shot, a folder or stack of clouds or shots, or an instrument's address; "
        "several are layers of one scene. Or a state that the page has saved.",
        read=True,
    ),
    camera: Path | None = opt(
        "H5", "For raw shots; made by calibrate.", shown="the one inside SOURCE"
    ),
    bin_width: float | None = opt(
        "PS", "For raw shots: duration of a row in ps.", name="--bin-width-ps"
    ),
    time_zero: float | None = TIME_ZERO,
    method: str | None = opt(
        "NAME",
        f"For shots and frames: {', '.join(METHODS.own)}, with few iterations, or one of tofclip plugins; "
        "surfaces for one shot.",
        shown="l1; frames as they were recovered",
        choices=METHODS,
    ),
    port: int | None = PORT,
    host: str = opt(
        "ADDRESS",
        "Where the page is served: an IP address of this computer; 0.0.0.0 for all of them.",
        "127.0.0.1",
    ),
    no_browser: bool = NO_BROWSER,
    desktop: bool = flag("--desktop", "Open a window instead of a page."),
    png: Path | None = opt(
        "PNG", f"Write a picture, without a screen: {PICTURE_FORMATS}.", shown="none"
    ),
    mp4: Path | None = opt("MP4", "Write a film, without a screen.", shown="none"),
) -> None:
    """Look at a source: on a page of the browser, in a window, as a picture or as a film.

    The page is for this computer, and for anyone who has its address with the token. Through ssh:
    ssh -L 8080:localhost:8080 HOST, then tofclip view SOURCE --port 8080 --no-browser there, and
    the address that it prints here. On the page, K shows the keys.

    Example: tofclip view frames.h5 --png scene.png
    """
    from pydantic import TypeAdapter

    from apps.viewer import still
    from apps.viewer.page import PageDoor
    from apps.viewer.session import Session, read_state, restore_state
    from apps.viewer.source import LayeredSource
    from apps.viewer.source_factory import ShotOptions, open_source

    # Truth values add up: more than one was asked for.
    if desktop + (png is not None) + (mp4 is not None) > 1:
        raise InputError("choose one of --desktop, --png and --mp4")
    for out, suffixes in ((png, PICTURE_SUFFIXES), (mp4, (".mp4",))):
        if out is not None:
            require_writable(out, *suffixes, inputs=(*source, camera))
    known, state = ShotOptions(camera and camera.resolve(), bin_width, time_zero, method), None
    if len(source) == 1 and source[0].endswith(".json"):
        state_file = Path(source[0])
        state = read_state(state_file)
        source, known = (
            state["sources"],
            TypeAdapter(ShotOptions).validate_python(state.get("options", {})),
        )
    started = time.perf_counter()
    is_page = not (desktop or png or mp4)
    door = PageDoor(host, port, no_browser)
    # Closing stops a live source and its threads, however the view ends.
    with contextlib.closing(door), contextlib.ExitStack() as opened:
        title = ", ".join(one if "://" in one else Path(one).name for one in source)
        with show_activity(f"opening {title}"):
            announce = partial(door.open_waiting, title) if is_page else lambda _: None
            found = [
                opened.enter_context(contextlib.closing(open_source(one, known, announce)))
                for one in source
            ]
            session = Session(found[0] if len(found) == 1 else LayeredSource(found))
            names = [one if "://" in one else str(Path(one).resolve()) for one in source]
            session.opened = {"sources": names, "options": asdict(known)}
            if state is not None:
                restore_state(session, state, state_file)
        if is_page:
            door.serve(session)
            return
        if desktop:
            still.open_window(session)
            return
        renderer, points, further = still.choose_renderer(), 0, {}
        if png is not None:
            points = still.save_picture(session, renderer, png)
        elif mp4 is not None:
            further = {"pictures": len(still.choose_frames(session))}
            with show_progress("filming", further["pictures"]) as advance:
                points = still.save_film(session, renderer, mp4, advance)
        figures = {"points": points, "backend": renderer.name}
        figures |= {"seconds": time.perf_counter() - started, **further}
        report(figures, [path for path in (png, mp4) if path is not None])
