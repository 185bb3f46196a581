"""Records and declared fields survive their file; damaged files and full disks are named; writing is
all or nothing.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import stat
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import Any

import h5py
import hypothesis.extra.numpy as hnp
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tofclip.errors import FileFormatError, StorageError
from tofclip.files import atomic_path, format_error_line
from tofclip.storage import (
    MAX_OUTLINE_VALUES,
    Field,
    Record,
    Storable,
    collect_provenance,
    is_stand_in,
    read_outline,
    stored_array,
    stored_attachments,
    stored_child,
    stored_origin,
    stored_part,
    stored_provenance,
    stored_texts,
    stored_value,
)

names = st.from_regex(r"[a-z][a-z_]{0,8}", fullmatch=True)
words = st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"), max_size=20)
scalars = st.one_of(words, st.booleans(), st.integers(-(2**62), 2**62), st.floats(allow_nan=False))
dtypes = st.sampled_from(["float32", "float64", "int64", "uint8", "bool", "complex64"])
arrays = dtypes.flatmap(
    lambda d: hnp.arrays(d, hnp.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=5))
)
fields = st.builds(
    Field, arrays, st.sampled_from(["", "s", "m", "px"]), st.lists(names, max_size=3).map(tuple)
)
attributes = st.dictionaries(words, scalars, max_size=4)
leaves = st.builds(Record, words, st.dictionaries(names, fields, max_size=3), attributes)
# Fields and children share one group of the file, hence the upper-case names of the children.
records = st.builds(
    Record,
    words,
    st.dictionaries(names, fields, max_size=3),
    attributes,
    st.dictionaries(names.map(str.upper), leaves, max_size=2),
    st.dictionaries(
        words, st.recursive(scalars, lambda s: st.lists(s, max_size=3), max_leaves=5), max_size=3
    ),
)


@pytest.fixture
def record() -> Record:
    counts = np.random.default_rng(1).random((40, 30))
    return Record(
        "streak", {"counts": Field(counts, "count", ("time", "column"))}, {"gain": 2.5, "name": "a"}
    )


def assert_same(got, expected):
    assert (got.kind, dict(got.attributes)) == (expected.kind, dict(expected.attributes))
    assert got.fields.keys() == expected.fields.keys()
    for name, entry in expected.fields.items():
        np.testing.assert_array_equal(got.fields[name].values, entry.values, strict=True)
        assert (got.fields[name].units, got.fields[name].axes) == (entry.units, entry.axes)
    assert got.children.keys() == expected.children.keys()
    for name, child in expected.children.items():
        assert_same(got.children[name], child)


@settings(
    max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(expected=records)
def test_a_record_survives_its_file(expected, tmp_path):
    expected.save(tmp_path / "record.h5")
    got = Record.load(tmp_path / "record.h5")
    assert_same(got, expected)
    assert got.provenance == expected.provenance
    assert got.origin == str(tmp_path / "record.h5")


@pytest.mark.parametrize("shape", [(300, 200), (70, 40, 50)])
def test_large_arrays_are_compressed_without_loss(shape, tmp_path):
    values = np.zeros(shape, np.float32)
    values[::7] = np.random.default_rng(0).random(values[::7].shape)
    Record("frames", {"values": Field(values)}).save(tmp_path / "a.h5")
    np.testing.assert_array_equal(Record.load(tmp_path / "a.h5").fields["values"].values, values)
    assert (tmp_path / "a.h5").stat().st_size < values.nbytes / 2


def test_text_longer_than_an_hdf5_attribute_survives(tmp_path):
    long = "é" * 70_000
    Record("x", attributes={"long": long}, provenance={"history": long}).save(tmp_path / "a.h5")
    got = Record.load(tmp_path / "a.h5")
    assert got.attributes["long"] == got.provenance["history"] == long


@pytest.mark.parametrize("kind", ["small", "compressed", "plain"])
def test_no_damaged_byte_goes_unnoticed(record, kind, tmp_path):
    """HDF5 reads some damaged files for ever and others as if nothing were wrong; checksums prevent
    both.
    """
    path = tmp_path / "a.h5"
    if kind != "small":
        values = np.random.default_rng(0).random((70, 40, 40), np.float32)
        record = Record("frames", {"values": Field(values)})
    record.save(path, kind != "plain")
    whole = path.read_bytes()
    positions = np.random.default_rng(2).integers(0, len(whole), 150)
    if kind != "small":  # where nothing but the array is
        positions = (np.linspace(0.2, 0.8, 9) * len(whole)).astype(int)
    for position in positions:
        damaged = bytearray(whole)
        damaged[position] ^= 0x41
        path.write_bytes(damaged)
        with pytest.raises(FileFormatError, match=r"a\.h5"):
            Record.load(path)


def edit(change):
    """Make a file of a record that was changed by hand."""

    def make(path, record):
        record.save(path)
        with h5py.File(path, "r+", libver=("v110", "v110")) as file:
            change(file)

    return make


def write_foreign(path, record):
    with h5py.File(path, "w") as file:
        file["data"] = [1.0]


def truncate(share):
    def make(path, record):
        record.save(path)
        os.truncate(path, int(path.stat().st_size * share))

    return make


def add_dataset(*shape, kind="f4", **options):
    def change(file):
        made = file.create_dataset("more", shape, kind, **options)
        made.attrs["units"] = made.attrs["axes"] = ""

    return edit(change)


def set_attribute(name, value):
    def change(file):
        file.attrs[name] = value

    return edit(change)


def add_link(link):
    def change(file):
        file["more"] = file["/"] if link is None else link

    return edit(change)


def add_external_data(path, record):
    (path.parent / "secret").write_bytes(bytes(80))
    add_dataset(10, kind="f8", external=[(str(path.parent / "secret"), 0, 80)])(path, record)


def add_virtual_data(path, record):
    with h5py.File(path.parent / "other.h5", "w") as other:
        other["x"] = np.ones(3)
    layout = h5py.VirtualLayout((3,), np.float64)
    layout[:] = h5py.VirtualSource(str(path.parent / "other.h5"), "x", (3,))
    edit(lambda file: file.create_virtual_dataset("more", layout))(path, record)


GZIP = {"chunks": (1 << 20,), "compression": "gzip"}
ODD = [np.zeros(5), np.zeros((2, 3), np.int32), h5py.Empty("f8"), 1j, np.bytes_(b"\xff\xfe z")]
NO_RECORDS = {
    "absent": (lambda path, record: None, "no such file"),
    "folder": (lambda path, record: path.mkdir(), "is a folder"),
    "empty": (lambda path, record: path.touch(), "is empty"),
    "text": (lambda path, record: path.write_text("not HDF5"), "is not an HDF5 file"),
    "foreign": (write_foreign, "not one of tofclip's"),
    **{f"{share}": (truncate(share), "is (damaged|not an HDF5)") for share in (0.05, 0.5, 0.999)},
    "newer": (set_attribute("format_version", 99), "format version 99"),
    "history": (set_attribute("provenance", "by hand"), "provenance is not JSON"),
    "soft link": (add_link(h5py.SoftLink("/nowhere")), "'more' cannot be read: links"),
    "soft": (add_link(h5py.SoftLink("/counts")), "link"),
    "external": (add_link(h5py.ExternalLink("other.h5", "x")), "link"),
    "cycle": (add_link(None), "link|deep"),
    "external data": (add_external_data, "other files"),
    "virtual": (add_virtual_data, "other files"),
    "words": (add_dataset(2, kind=h5py.string_dtype()), "fixed size"),
    "tebibyte": (add_dataset(1 << 38, **GZIP), r"'more' claims \d+ bytes"),
    "gibibytes": (add_dataset(1 << 30, **GZIP), r"'more' claims \d+ bytes"),
    "chunk": (
        add_dataset(4, chunks=(1 << 29,), maxshape=(None,), compression="gzip"),
        "'more' claims",
    ),
    **{
        f"{name} {number}": (set_attribute(name, value), None)
        for name in ("format_version", "kind", "value.gain")
        for number, value in enumerate(ODD)
    },
}


@pytest.mark.parametrize("name", NO_RECORDS)
def test_what_is_no_record_is_named_in_one_line(record, name, tmp_path):
    make, problem = NO_RECORDS[name]
    make(tmp_path / "a.h5", record)
    for read in (Record.load, read_outline):
        if name == "gibibytes" and read is read_outline:
            continue  # which reads no values
        with pytest.raises((FileFormatError, StorageError), match=problem) as caught:
            read(tmp_path / "a.h5")
        assert "\n" not in str(caught.value)


def test_kind_fields_attributes_and_children_are_checked(record, tmp_path):
    record.save(tmp_path / "a.h5")
    assert Record.load(tmp_path / "a.h5", "frames", "streak").kind == "streak"
    assert record.array("counts", np.float32, 2, "count").dtype == np.float32
    parent = Record("frames", children={"shot": record})
    assert (record.attribute("gain"), record.attribute("absent", 7)) == (2.5, 7)
    assert parent.child("shot", "streak") is record
    for problem, ask in {
        "a streak record, expected camera or frames": lambda: Record.load(
            tmp_path / "a.h5", "camera", "frames"
        ),
        "no field 'times'": lambda: record.array("times", np.float32, 1),
        "must have 3 dimensions": lambda: record.array("counts", np.float32, 3, "count"),
        "must be in 's', found 'count'": lambda: record.array("counts", np.float32, 2, "s"),
        "must convert to int32": lambda: record.array("counts", np.int32, 2, "count"),
        "no attribute 'absent'": lambda: record.attribute("absent"),
        "carries no camera 'shot'": lambda: parent.child("shot", "camera"),
        "carries no camera 'camera'": lambda: parent.child("camera", "camera"),
    }.items():
        with pytest.raises(FileFormatError, match=problem):
            ask()


def test_what_does_not_fit_into_memory_is_said(record, tmp_path, monkeypatch):
    record.save(tmp_path / "a.h5")

    def refuse(*_):
        raise MemoryError

    monkeypatch.setattr(h5py.Dataset, "__getitem__", refuse)
    with pytest.raises(StorageError, match="does not fit into this computer's memory"):
        Record.load(tmp_path / "a.h5")


def test_another_librarys_message_is_one_line_of_readable_length():
    assert format_error_line(ValueError("a\n b")) == "a b"
    assert format_error_line(ValueError()) == "ValueError"
    assert len(format_error_line(ValueError("(" * 6000))) < 210


def test_a_number_is_finite_and_what_is_found_stays_on_one_line():
    attributes = {"text": "a\nb", "none": np.inf, "some": np.int64(3)}
    record = Record("thing", {}, attributes, origin="x.h5")
    assert record.number("some") == record.number("absent", 3.0) == 3.0
    for name in ("text", "none"):
        with pytest.raises(FileFormatError, match=r"must be a number, found (a b|inf)$"):
            record.number(name)
    with pytest.raises(FileFormatError, match="has no attribute 'absent'"):
        record.number("absent")


@pytest.mark.parametrize("fault", [ValueError, KeyboardInterrupt, OSError, StorageError])
def test_an_interrupted_write_leaves_the_old_file(fault: type[BaseException], tmp_path):
    target = tmp_path / "scene.ply"
    target.write_text("old")

    def write():
        with atomic_path(target) as temporary:
            temporary.write_text("half")
            raise fault("stop")

    with pytest.raises(StorageError if fault is OSError else fault, match=r"stop$") as caught:
        write()
    # What the block itself reports about some other file keeps its words.
    assert ("scene.ply" in str(caught.value)) == (fault is OSError)
    assert target.read_text() == "old"
    assert os.listdir(tmp_path) == ["scene.ply"]


def test_atomic_path_replaces_the_file_at_the_end_only(tmp_path):
    target = tmp_path / "scene.ply"
    target.write_text("old")
    with atomic_path(target) as temporary:
        temporary.write_text("new")
        assert target.read_text() == "old"
        assert temporary.suffix == ".ply"
        assert temporary.parent == tmp_path
    assert target.read_text() == "new"
    assert os.listdir(tmp_path) == ["scene.ply"]


def test_unwritable_places_are_named(record, tmp_path):
    (tmp_path / "file").touch()
    (tmp_path / "folder").mkdir()
    for name, problem in (
        ("absent/a.h5", "the folder does not exist"),
        ("file/a.h5", "its folder is a file"),
        ("folder", "it is a folder"),
    ):
        with pytest.raises(StorageError, match=problem):
            record.save(tmp_path / name)
    assert sorted(os.listdir(tmp_path)) == ["file", "folder"]


def test_forbidden_places_are_named(record, tmp_path, monkeypatch):
    def refuse(*_, **__):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("os.open", refuse)
    with pytest.raises(StorageError, match=r"a\.h5: cannot be written: writing is not permitted"):
        record.save(tmp_path / "a.h5")
    monkeypatch.setattr("builtins.open", refuse)
    with pytest.raises(StorageError, match=r"a\.h5: reading is not permitted"):
        Record.load(tmp_path / "a.h5")


FULL_DISK = """
import resource, sys
import h5py, numpy as np
from tofclip.errors import StorageError
from tofclip.storage import Field, Record

record = Record("frames", {"values": Field(np.random.default_rng(0).random((60, 50, 50)))})
resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000))
try:
    record.save(sys.argv[1])
except StorageError as fault:
    print(fault)
"""


@pytest.mark.skipif(os.name != "posix", reason="needs a limit on the size of files")
def test_a_full_disk_is_an_error_and_leaves_nothing(tmp_path):
    """A limit on file size stands for the full disk: the write fails half way. HDF5 itself would
    crash.
    """
    target = tmp_path / "frames.h5"
    target.write_text("old")
    command = [sys.executable, "-c", FULL_DISK, str(target)]
    child = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert (child.returncode, child.stderr) == (0, "")
    assert child.stdout.startswith(f"{target}: cannot be written: the disk is full")
    assert target.read_text() == "old"
    assert os.listdir(tmp_path) == ["frames.h5"]


@pytest.mark.parametrize("fault", [RuntimeError("code C20"), OSError("9 requested and 3 written")])
@pytest.mark.parametrize("free", [0, 1 << 30])
def test_a_librarys_own_error_on_a_full_disk_is_named(tmp_path, monkeypatch, fault, free):
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=free))
    expected = StorageError if free == 0 or isinstance(fault, OSError) else RuntimeError
    reason = "the disk is full" if free == 0 else str(fault)

    def write_half():
        with atomic_path(tmp_path / "scene.e57") as temporary:
            temporary.write_bytes(b"half")
            raise fault

    with pytest.raises(expected, match=reason):
        write_half()
    assert list(tmp_path.iterdir()) == []


def test_provenance_names_the_inputs(tmp_path):
    (tmp_path / "in.tif").write_bytes(b"pixels")
    found = collect_provenance({"iterations": 3}, tmp_path / "in.tif", tmp_path / "absent")
    assert found["settings"] == {"iterations": 3}
    assert found["inputs"] == [{"name": "in.tif", "sha256": hashlib.sha256(b"pixels").hexdigest()}]
    assert found["software"].startswith("tofclip ")
    assert found["created"].endswith("+00:00")


def test_files_get_the_permissions_of_any_new_file_and_the_umask_is_left_alone(
    tmp_path, monkeypatch
):
    (tmp_path / "plain").touch()

    def refuse(_) -> int:
        raise AssertionError("the umask belongs to the whole process")

    monkeypatch.setattr(os, "umask", refuse)
    with atomic_path(tmp_path / "a.txt") as temporary:
        temporary.write_text("text")
    assert (tmp_path / "a.txt").stat().st_mode == (tmp_path / "plain").stat().st_mode


def test_contents_are_on_the_disk_before_the_name_is(tmp_path, monkeypatch):
    steps: list[str] = []
    sync, rename = os.fsync, os.replace

    def note_sync(handle):
        is_folder = stat.S_ISDIR(os.fstat(handle).st_mode)
        size = os.fstat(handle).st_size
        steps.append("folder" if is_folder else f"{size} bytes")
        sync(handle)

    def note_rename(source, target):
        steps.append("rename")
        rename(source, target)

    monkeypatch.setattr(os, "fsync", note_sync)
    monkeypatch.setattr(os, "replace", note_rename)
    with atomic_path(tmp_path / "a.txt") as temporary:
        temporary.write_text("text")
    assert steps == ["4 bytes", "rename", "folder"]


def test_an_outline_has_no_values_but_a_few(record, tmp_path):
    few = Field(np.arange(3.0), "px", ("view",))
    record = replace(record, fields={**record.fields, "few": few})
    large = Field(np.random.default_rng(0).random((300, 400)), "m", ("y", "x"))
    replace(record, fields={**record.fields, "large": large}).save(tmp_path / "a.h5")
    outline = read_outline(tmp_path / "a.h5").fields
    assert set(outline) == {*record.fields, "large"}
    assert is_stand_in(outline["large"].values)
    assert (outline["large"].values.shape, outline["large"].axes) == ((300, 400), ("y", "x"))
    for name, entry in record.fields.items():
        if entry.values.size <= MAX_OUTLINE_VALUES:
            np.testing.assert_array_equal(outline[name].values, entry.values)
            assert not is_stand_in(outline[name].values)


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
        ({"attributes": {"rows": "many", "columns": 2}}, "'rows' must be of type int"),
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
