"""Every instrument has a page, which names every value that its address takes."""

from __future__ import annotations

from pathlib import Path

import pytest

import tofclip
from devices.aravis import CameraOptions
from devices.emulation.linospad2 import SimulationOptions
from devices.histogram_kits import Tmf8828Options, Vl53l8Options
from devices.registry import FILE_OPENERS, OPENERS
from devices.remoteex import RemoteExOptions
from devices.spad512 import SpadOptions
from devices.timetag import TimeTagOptions

DOCS = Path(tofclip.__file__).parents[1] / "docs"
PAGES = {
    "timetag": TimeTagOptions.names(),
    "remoteex": RemoteExOptions.names(),
    "spad512": SpadOptions.names(),
    "aravis": CameraOptions.names(),
    "histogram_kits": (*Tmf8828Options.names(), *Vl53l8Options.names()),
    "linospad2": SimulationOptions.names(),
}


@pytest.mark.parametrize("page", PAGES)
def test_a_page_names_every_value_of_the_address(page: str) -> None:
    text = (DOCS / "instruments" / f"{page}.md").read_text()
    assert [name for name in PAGES[page] if f"`{name}`" not in text] == []
    assert f"instruments/{page}" in (DOCS / "instruments.md").read_text()


def test_every_address_is_on_a_page() -> None:
    pages = {path.stem: path.read_text() for path in (DOCS / "instruments").glob("*.md")}
    text = "\n".join(pages.values())
    assert set(pages) == {*PAGES, "files"}
    assert [scheme for scheme in OPENERS if f"{scheme}://" not in text] == []
    endings = [ending for ending in FILE_OPENERS if ending.startswith(".")]
    assert [one for one in endings if one not in (".tiff", ".hdf5") and one not in text] == []
