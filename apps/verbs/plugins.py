"""`tofclip plugins`: the parts that have names, ours and those of other packages."""

from __future__ import annotations

import inspect
from collections.abc import Iterator, Mapping, Sequence
from textwrap import shorten
from typing import Any

from apps.options import JSON, arg
from apps.report import report
from devices.address import Options
from tofclip.errors import InputError
from tofclip.plugins import DENOISERS, METHODS, READERS, Parts, Reader, find_type, list_settings

TEXT_WIDTH = 70  # columns, of a part's meaning in the list of all


def plugins(
    name: str | None = arg("NAME", "Of one part: show its settings.", None),
    as_json: bool = JSON,
) -> None:
    """List methods, denoisers, readers and instruments, by whom they are, and what does not load.

    A package adds its own by entry points; docs/extending.md has a template. Of one part this shows
    what it is and the settings that --set takes, with their defaults.

    Example: tofclip plugins

    Example: tofclip plugins red
    """
    shown = [one for one in list_parts() if name in (None, one["name"])]
    if not shown:
        raise InputError(f"no part is called '{name}'; tofclip plugins lists them all")
    if as_json:
        report({"parts": shown}, as_json)
        return
    width = max(len(one["name"]) for one in shown)
    for one in shown:
        text = one["fault"] or (one["meaning"] if name else shorten(one["meaning"], TEXT_WIDTH))
        print(f"{one['group']:<18}{one['name']:<{width}}  {one['origin']:<12}  {text}")
        for setting in one["settings"] if name else ():
            lead = "?" if one["group"] == "tofclip.sources" else "--set "
            print(f"    {lead}{setting['name']}={setting['default']}")


def list_parts() -> Iterator[dict[str, Any]]:
    """Describe every part; `fault`: why it cannot be used, where it cannot."""
    from devices.registry import CODECS, FINDERS, SOURCES
    from nlos.io.format_detection import READERS as CAPTURE_READERS
    from nlos.settings import METHODS as HIDDEN_SCENE_METHODS

    streaks = METHODS, DENOISERS, READERS, SOURCES, FINDERS, CODECS
    own = *streaks, HIDDEN_SCENE_METHODS, CAPTURE_READERS
    for parts in own:
        for name in parts:
            yield _describe(parts, name)
        for name, package in parts.list_unused():
            fault = f"not used: {parts.get_origin(name)} has this name already"
            yield _make_entry(parts, name, package, fault)


def _describe(parts: Parts, name: str) -> dict[str, Any]:
    origin = parts.get_origin(name)
    try:
        part = parts[name]
    except InputError as fault:
        return _make_entry(parts, name, origin, str(fault))
    makes = parts.kind in ("method", "denoiser", "codec")  # the others are used as they are
    known = {} if isinstance(part, Reader) or not makes else list_settings(part)
    settings = [
        {"name": one, "default": _show_default(value)}
        for one, value in known.items()
        if find_type(value)
    ]
    if inspect.isfunction(part):  # an opener: the options that it reads an address by
        used = inspect.getclosurevars(part).globals.values()
        settings += [
            {"name": entry.name, "default": str(entry.default)}
            for one in used
            if inspect.isclass(one) and issubclass(one, Options)
            for entry in one.declared()
        ]
    explained = part.read if isinstance(part, Reader) else part
    meaning = (inspect.getdoc(explained) or "").split("\n\n")[0]
    return _make_entry(parts, name, origin, "", " ".join(meaning.split()), settings)


def _make_entry(
    parts: Parts,
    name: str,
    origin: str,
    fault: str,
    meaning: str = "",
    settings: Sequence[Mapping[str, str]] = (),
) -> dict[str, Any]:
    known = {"group": parts.group, "name": name, "origin": origin, "fault": fault}
    return known | {"meaning": meaning, "settings": list(settings)}


def _show_default(setting: inspect.Parameter) -> str:
    if setting.default is setting.empty:
        return "needed"
    return "its own" if "factory" in str(setting.default) else str(setting.default)
