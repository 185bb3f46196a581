"""Declared fields survive their file; what a file lacks is named or takes its default."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest

from tofclip.errors import FileFormatError
from tofclip.storage import (
    Field,
    Record,
    Storable,
    stored_array,
    stored_attachments,
    stored_child,
    stored_origin,
    stored_part,
    stored_provenance,
    stored_texts,
    stored_value,
)


@dataclass(frozen=True)
class Part(Storable):
    RECORD_KIND = "part"

    length: float = field(metadata=stored_value("length_m"))
    label: str = field(default="a", metadata=stored_value(dtype=str, optional=True))


@dataclass(frozen=True)
class Whole(Storable):
    RECORD_KIND = "whole"

    counts: Any = field(metadata=stored_array("count", "time", "x", dtype=np.float32))
    shape: tuple[int, int] = field(metadata=stored_value("rows", "columns", dtype=int))
    inner: Part = field(metadata=stored_part(Part))
    mask: Any = field(default=None, metadata=stored_array("", "x", dtype=bool, optional=True))
    free: Any = field(
        default_factory=lambda: np.zeros((1, 1), np.complex64),
        metadata=stored_array("m", "y", "x", dtype=np.complex64),
    )
    other: Part | None = field(
        default=None, metadata=stored_child(Part.from_record, "part", optional=True)
    )
    texts: Mapping[str, str] = field(default_factory=dict, metadata=stored_texts())
    attachments: Mapping[str, Record] = field(default_factory=dict, metadata=stored_attachments())
    source: str = field(default="nowhere", metadata=stored_origin())
    provenance: Mapping[str, Any] = field(default_factory=dict, metadata=stored_provenance())


WHOLE = Whole(np.ones((3, 2), np.float32), (4, 5), Part(0.5))


def test_every_kind_of_field_survives_its_file(tmp_path):
    made = replace(
        WHOLE,
        mask=np.array([True, False]),
        free=np.full((2, 3), 1j, np.complex64),
        other=Part(2.0, "b"),
        texts={"key": "text"},
        attachments={"wall": Record("wall", {"y": Field(np.ones(2), "m")})},
        provenance={"by": "test"},
    )
    made.save(tmp_path / "a.h5")
    back = Whole.load(tmp_path / "a.h5")
    assert back.source == str(tmp_path / "a.h5")
    assert (back.shape, back.inner, back.other) == ((4, 5), made.inner, made.other)
    assert (back.texts, back.provenance) == (made.texts, made.provenance)
    assert list(back.attachments) == ["wall"]
    for name in ("counts", "mask", "free"):
        np.testing.assert_array_equal(getattr(back, name), getattr(made, name))
        assert getattr(back, name).dtype == getattr(made, name).dtype
    stored = Record.load(tmp_path / "a.h5")
    assert stored.fields["counts"].units == "count"
    assert stored.fields["counts"].axes == ("time", "x")
    assert stored.fields["free"].axes == ("y", "x")
    assert stored.attributes == {"rows": 4, "columns": 5, "length_m": 0.5, "label": "a"}


def test_what_is_optional_may_be_absent():
    record = WHOLE.to_record()
    assert "mask" not in record.fields
    assert "other" not in record.children
    attributes = {name: value for name, value in record.attributes.items() if name != "label"}
    back = Whole.from_record(replace(record, attributes=attributes))
    assert back.mask is None
    assert back.other is None
    assert back.inner.label == "a"
    assert back.source == "nowhere"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"fields": {}}, "no field 'counts'"),
        ({"attributes": {"rows": 1, "columns": 2}}, "no attribute 'length_m'"),
        (
            {"attributes": {"rows": "many", "columns": 2, "length_m": 1.0}},
            "attribute 'rows' must be of type int",
        ),
        ({"fields": {"counts": Field(np.ones((3, 2)), "s")}}, "must be in 'count'"),
        ({"fields": {"counts": Field(np.ones(3), "count")}}, "must have 2 dimensions"),
    ],
)
def test_what_is_declared_must_be_there(change, message):
    with pytest.raises(FileFormatError, match=message):
        Whole.from_record(replace(WHOLE.to_record(), **change))


def test_an_array_without_elements_can_be_left_out():
    @dataclass(frozen=True)
    class Board(Storable):
        RECORD_KIND = "board"

        hot: Any = field(
            default=(),
            metadata=stored_array("px", "hot", dtype=np.int64, skip_empty=True, optional=True),
        )

    assert not Board().to_record().fields
    assert Board.from_record(Board().to_record()).hot == ()
    assert Board.from_record(Board([3]).to_record()).hot.tolist() == [3]
