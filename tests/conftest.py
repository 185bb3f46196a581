"""What every test may ask for."""

from __future__ import annotations

import os
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder with the instruments' recorded data; tests that need it are skipped where it is
    absent.
    """
    folder = Path(os.environ.get("TOFCLIP_DATA", Path(__file__).parents[2] / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(f"no recorded data in {folder}; name its folder in TOFCLIP_DATA")
    return folder
