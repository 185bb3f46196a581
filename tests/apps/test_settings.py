"""Settings: from files and flags to what a verb works with, and back into a file."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from apps.settings import load_settings, save_settings, setting, settings_to_dict
from apps.verbs.nlos import ReconstructSettings
from apps.verbs.nlos_scenes import CompareSettings
from nlos.known_scenes import WALLS, SceneSettings
from tofclip.errors import FileFormatError, InputError, StorageError


@dataclass(frozen=True)
class Sample:
    """One setting of every type."""

    name: str | None = setting("TEXT", "A text.")
    length: float | None = setting("M", "A length.", unit="m")
    facet: float | None = setting("MM", "A short one.", unit="m", written="mm")
    count: int = setting("N", "A number.", 2)
    whole: bool = setting(None, "A choice.", False)
    ends: tuple[float, float] | None = setting("M M", "A pair.", unit="m")


NUMBERS = st.floats(allow_nan=False, allow_infinity=False)
SAMPLES = st.builds(
    Sample,
    name=st.none() | st.text(st.characters(exclude_categories=["Cs"])),
    length=st.none() | NUMBERS,
    count=st.integers(-(2**63), 2**63 - 1),
    whole=st.booleans(),
    ends=st.none() | st.tuples(NUMBERS, NUMBERS),
)


@given(sample=SAMPLES)
def test_what_is_written_is_read_back_to_the_last_bit(
    sample: Sample, tmp_path_factory: pytest.TempPathFactory
) -> None:
    path = tmp_path_factory.getbasetemp() / "sample.toml"
    save_settings(sample, path, "a sample")
    assert repr(load_settings(Sample, path, {})) == repr(sample)  # as text, for -0.0 equals 0.0


def test_flags_win_over_the_file_and_the_file_over_the_defaults(tmp_path: Path) -> None:
    path = tmp_path / "settings.toml"
    path.write_text("length_m = 3\ncount = 5\nends_m = [1, 2.5]\n")
    found = load_settings(Sample, path, {"count": 7, "name": None, "whole": False})
    assert found == Sample(length=3.0, count=7, ends=(1.0, 2.5))
    assert isinstance(found.length, float)
    assert load_settings(Sample, None, {}) == Sample()
    assert settings_to_dict(Sample(count=3)) == {"count": 3, "whole": False}


@given(st.decimals(1, 9999, places=4).map(float))
def test_lengths_in_mm_are_metres_inside_and_come_back_as_they_were(facet_mm: float) -> None:
    found = load_settings(Sample, None, {"facet_mm": facet_mm})
    assert found.facet == facet_mm * 1e-3
    assert settings_to_dict(found)["facet_mm"] == facet_mm


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("lenght_m = 1", "did you mean 'length_m'"),
        ("zzz = 1", "known are name, length_m, facet_mm, count, whole, ends_m"),
        ("length_m = 'one'", "length_m must be a finite number, got 'one'"),
        ("length_m = true", "length_m must be a finite number"),
        ("length_m = nan", "length_m must be a finite number"),
        ("count = 1.5", "count must be a whole number"),
        ("whole = 1", "whole must be true or false"),
        ("name = 1", "name must be a text in quotes"),
        ("ends_m = [1, 2, 3]", "ends_m must be a list of 2 finite numbers"),
        ("ends_m = 1", "ends_m must be a list of 2 finite numbers"),
        ("[table]\na = 1", "no setting is called 'table'"),
    ],
)
def test_what_makes_no_sense_is_refused(text: str, complaint: str, tmp_path: Path) -> None:
    path = tmp_path / "settings.toml"
    path.write_text(text)
    with pytest.raises(InputError, match=r"settings\.toml") as caught:
        load_settings(Sample, path, {})
    assert complaint in str(caught.value)


@pytest.mark.parametrize("content", [b"length_m = = 1", b"name = '\xff'"])
def test_files_that_are_no_toml(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "settings.toml"
    path.write_bytes(content)
    with pytest.raises(FileFormatError, match="is not a TOML file of settings"):
        load_settings(Sample, path, {})
    with pytest.raises(StorageError, match="no such file"):
        load_settings(Sample, tmp_path / "absent.toml", {})


def test_walls_are_those_of_the_simulation() -> None:
    from nlos import simulate

    assert tuple(simulate.WALLS) == WALLS


@pytest.mark.parametrize("kind", [ReconstructSettings, CompareSettings, SceneSettings])
def test_every_setting_can_be_told_by_a_file(kind: type, tmp_path: Path) -> None:
    """Values of each field's own type go out and come back."""
    examples = {"float": 0.5, "int": 3, "str": "a", "bool": True, "tuple[float, float]": (0.5, 1.5)}
    values = {
        field.name: examples[
            str(field.type).removesuffix(" | None").replace("Limits", "tuple[float, float]")
        ]
        for field in fields(kind)
        if "help" in field.metadata and field.name not in ("gate_found", "reasons")
    }
    save_settings(kind(**values), tmp_path / "all.toml", "all of them")
    assert load_settings(kind, tmp_path / "all.toml", {}) == kind(**values)
