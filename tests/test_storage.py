"""Records survive their file; damaged files and full disks are named; writing is all or nothing."""

from __future__ import annotations

import hashlib
import os
import shutil
import stat
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

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
    collect_provenance,
    is_stand_in,
    read_outline,
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


def assert_same(got: Record, expected: Record) -> None:
    assert (got.kind, dict(got.attributes)) == (expected.kind, dict(expected.attributes))
    assert got.fields.keys() == expected.fields.keys()
    for name, entry in expected.fields.items():
        stored = got.fields[name]
        np.testing.assert_array_equal(stored.values, entry.values)
        assert (stored.values.dtype, stored.units, stored.axes) == (
            entry.values.dtype,
            entry.units,
            entry.axes,
        )
    assert got.children.keys() == expected.children.keys()
    for name, child in expected.children.items():
        assert_same(got.children[name], child)


@settings(
    max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(expected=records)
def test_a_record_survives_its_file(expected: Record, tmp_path: Path) -> None:
    expected.save(tmp_path / "record.h5")
    got = Record.load(tmp_path / "record.h5")
    assert_same(got, expected)
    assert got.provenance == expected.provenance
    assert got.origin == str(tmp_path / "record.h5")


@pytest.mark.parametrize("shape", [(300, 200), (70, 40, 50)])
def test_large_arrays_are_compressed_without_loss(shape: tuple[int, ...], tmp_path: Path) -> None:
    values = np.zeros(shape, np.float32)
    values[::7] = np.random.default_rng(0).random(values[::7].shape)
    Record("frames", {"values": Field(values)}).save(tmp_path / "a.h5")
    np.testing.assert_array_equal(Record.load(tmp_path / "a.h5").fields["values"].values, values)
    assert (tmp_path / "a.h5").stat().st_size < values.nbytes / 2


def test_text_longer_than_an_hdf5_attribute_survives(tmp_path: Path) -> None:
    long = "é" * 70_000
    Record("x", attributes={"long": long}, provenance={"history": long}).save(tmp_path / "a.h5")
    got = Record.load(tmp_path / "a.h5")
    assert got.attributes["long"] == got.provenance["history"] == long


def test_no_damaged_byte_goes_unnoticed(record: Record, tmp_path: Path) -> None:
    """HDF5 reads some damaged files for ever and others as if nothing were wrong; checksums prevent
    both.
    """
    path = tmp_path / "a.h5"
    record.save(path)
    whole = path.read_bytes()
    for position in np.random.default_rng(2).integers(0, len(whole), 150):
        damaged = bytearray(whole)
        damaged[position] ^= 0x41
        path.write_bytes(damaged)
        with pytest.raises(FileFormatError, match=r"a\.h5"):
            Record.load(path)


@pytest.mark.parametrize("compressed", [True, False])
def test_no_damaged_byte_of_a_large_array_goes_unnoticed(compressed: bool, tmp_path: Path) -> None:
    path, values = tmp_path / "a.h5", np.random.default_rng(0).random((70, 40, 40), np.float32)
    Record("frames", {"values": Field(values)}).save(path, compressed)
    whole = path.read_bytes()
    for position in np.linspace(0.2, 0.8, 9):  # where nothing but the array is
        damaged = bytearray(whole)
        damaged[int(position * len(whole))] ^= 0x41
        path.write_bytes(damaged)
        with pytest.raises(FileFormatError, match=r"a\.h5"):
            Record.load(path)


@pytest.mark.parametrize("share", [0.05, 0.5, 0.999])
def test_a_truncated_file_is_refused(record: Record, share: float, tmp_path: Path) -> None:
    path = tmp_path / "a.h5"
    record.save(path)
    os.truncate(path, int(path.stat().st_size * share))
    with pytest.raises(FileFormatError, match=r"a\.h5: is (damaged|not an HDF5)"):
        Record.load(path)


def test_what_is_no_record_is_named(tmp_path: Path) -> None:
    (tmp_path / "empty.h5").touch()
    (tmp_path / "text.h5").write_text("not HDF5")
    with h5py.File(tmp_path / "foreign.h5", "w") as file:
        file["data"] = [1.0]
    for name, fault, problem in (
        ("absent.h5", StorageError, "no such file"),
        ("", StorageError, "is a folder"),
        ("empty.h5", FileFormatError, "is empty"),
        ("text.h5", FileFormatError, "is not an HDF5 file"),
        ("foreign.h5", FileFormatError, "not one of tofclip's"),
    ):
        with pytest.raises(fault, match=problem):
            Record.load(tmp_path / name)


def test_a_newer_format_is_refused(record: Record, tmp_path: Path) -> None:
    record.save(tmp_path / "a.h5")
    with h5py.File(tmp_path / "a.h5", "r+") as file:
        file.attrs["format_version"] = 99
    with pytest.raises(FileFormatError, match="format version 99"):
        Record.load(tmp_path / "a.h5")


def test_content_that_is_not_ours_is_refused(record: Record, tmp_path: Path) -> None:
    record.save(tmp_path / "a.h5")
    with h5py.File(tmp_path / "a.h5", "r+") as file:
        file["link"] = h5py.SoftLink("/nowhere")
    with pytest.raises(FileFormatError, match="'link' cannot be read"):
        Record.load(tmp_path / "a.h5")
    with h5py.File(tmp_path / "a.h5", "r+") as file:
        del file["link"]
        file.attrs["provenance"] = "by hand"
    with pytest.raises(FileFormatError, match="provenance is not JSON"):
        Record.load(tmp_path / "a.h5")


def test_a_record_of_another_kind_is_refused(record: Record, tmp_path: Path) -> None:
    record.save(tmp_path / "a.h5")
    assert Record.load(tmp_path / "a.h5", "frames", "streak").kind == "streak"
    with pytest.raises(FileFormatError, match="holds a streak record, expected camera or frames"):
        Record.load(tmp_path / "a.h5", "camera", "frames")


def test_array_checks_name_dimensions_units_and_type(record: Record) -> None:
    counts = record.array("counts", np.float32, 2, "count")
    assert counts.dtype == np.float32
    for problem, arguments in {
        "no field 'times'": ("times", np.float32, 1),
        "must have 3 dimensions": ("counts", np.float32, 3, "count"),
        "must be in 's', found 'count'": ("counts", np.float32, 2, "s"),
        "must convert to int32, found float64": ("counts", np.int32, 2, "count"),
    }.items():
        with pytest.raises(FileFormatError, match=problem):
            record.array(*arguments)


def test_attributes_and_children_are_checked(record: Record) -> None:
    parent = Record("frames", children={"shot": record})
    assert record.attribute("gain") == 2.5
    assert record.attribute("absent", 7) == 7
    assert parent.child("shot", "streak") is record
    with pytest.raises(FileFormatError, match="no attribute 'absent'"):
        record.attribute("absent")
    for name, kind in (("shot", "camera"), ("camera", "camera")):
        with pytest.raises(FileFormatError, match=f"carries no camera '{name}'"):
            parent.child(name, kind)


@pytest.mark.parametrize(
    "value",
    [np.zeros(5), np.zeros((2, 3), np.int32), h5py.Empty("f8"), 1j, np.bytes_(b"\xff\xfe z")],
    ids=["list", "table", "empty", "complex", "no text"],
)
@pytest.mark.parametrize("name", ["format_version", "kind", "value.number"])
def test_an_attribute_is_text_or_a_number(name: str, value: object, tmp_path: Path) -> None:
    path = tmp_path / "odd.h5"
    Record("thing", {}, {"number": 3}).save(path)
    with h5py.File(path, "r+") as file:
        file.attrs[name] = value
    for read in (Record.load, read_outline):
        with pytest.raises(FileFormatError) as caught:
            read(path)
        assert "\n" not in str(caught.value)


def test_another_librarys_message_is_one_line_of_readable_length() -> None:
    assert format_error_line(ValueError("a\n b")) == "a b"
    assert format_error_line(ValueError()) == "ValueError"
    assert len(format_error_line(ValueError("(" * 6000))) < 210


def test_a_number_is_finite_and_what_is_found_stays_on_one_line() -> None:
    record = Record(
        "thing", {}, {"text": "a\nb", "none": np.inf, "some": np.int64(3)}, origin="x.h5"
    )
    assert record.number("some") == record.number("absent", 3.0) == 3.0
    for name in ("text", "none"):
        with pytest.raises(FileFormatError, match=r"must be a number, found (a b|inf)$"):
            record.number(name)
    with pytest.raises(FileFormatError, match="has no attribute 'absent'"):
        record.number("absent")


@pytest.mark.parametrize("fault", [ValueError, KeyboardInterrupt, OSError, StorageError])
def test_an_interrupted_write_leaves_the_old_file(
    fault: type[BaseException], tmp_path: Path
) -> None:
    target = tmp_path / "scene.ply"
    target.write_text("old")

    def write() -> None:
        with atomic_path(target) as temporary:
            temporary.write_text("half")
            raise fault("stop")

    with pytest.raises(StorageError if fault is OSError else fault, match=r"stop$") as caught:
        write()
    # What the block itself reports about some other file keeps its words.
    assert ("scene.ply" in str(caught.value)) == (fault is OSError)
    assert target.read_text() == "old"
    assert os.listdir(tmp_path) == ["scene.ply"]


def test_atomic_path_replaces_the_file_at_the_end_only(tmp_path: Path) -> None:
    target = tmp_path / "scene.ply"
    target.write_text("old")
    with atomic_path(target) as temporary:
        temporary.write_text("new")
        assert target.read_text() == "old"
        assert temporary.suffix == ".ply"
        assert temporary.parent == tmp_path
    assert target.read_text() == "new"
    assert os.listdir(tmp_path) == ["scene.ply"]


def test_unwritable_places_are_named(record: Record, tmp_path: Path) -> None:
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


def test_forbidden_places_are_named(
    record: Record, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("os.open", refuse)
    with pytest.raises(
        StorageError, match=r"a\.h5: cannot be written: writing is not permitted there"
    ):
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
def test_a_full_disk_is_an_error_and_leaves_nothing(tmp_path: Path) -> None:
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
def test_a_librarys_own_error_on_a_full_disk_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fault: Exception, free: int
) -> None:
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=free))
    expected = StorageError if free == 0 or isinstance(fault, OSError) else RuntimeError
    reason = "the disk is full" if free == 0 else str(fault)

    def write_half() -> None:
        with atomic_path(tmp_path / "scene.e57") as temporary:
            temporary.write_bytes(b"half")
            raise fault

    with pytest.raises(expected, match=reason):
        write_half()
    assert list(tmp_path.iterdir()) == []


def test_provenance_names_the_inputs(tmp_path: Path) -> None:
    (tmp_path / "in.tif").write_bytes(b"pixels")
    found = collect_provenance({"iterations": 3}, tmp_path / "in.tif", tmp_path / "absent")
    assert found["settings"] == {"iterations": 3}
    assert found["inputs"] == [{"name": "in.tif", "sha256": hashlib.sha256(b"pixels").hexdigest()}]
    assert found["software"].startswith("tofclip ")
    assert found["created"].endswith("+00:00")


def test_files_get_the_permissions_of_any_new_file_and_the_umask_is_left_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "plain").touch()

    def refuse(_: int) -> int:
        raise AssertionError("the umask belongs to the whole process")

    monkeypatch.setattr(os, "umask", refuse)
    with atomic_path(tmp_path / "a.txt") as temporary:
        temporary.write_text("text")
    assert (tmp_path / "a.txt").stat().st_mode == (tmp_path / "plain").stat().st_mode


def test_contents_are_on_the_disk_before_the_name_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    steps: list[str] = []
    sync, rename = os.fsync, os.replace

    def note_sync(handle: int) -> None:
        is_folder = stat.S_ISDIR(os.fstat(handle).st_mode)
        size = os.fstat(handle).st_size
        steps.append("folder" if is_folder else f"{size} bytes")
        sync(handle)

    def note_rename(source: Path, target: Path) -> None:
        steps.append("rename")
        rename(source, target)

    monkeypatch.setattr(os, "fsync", note_sync)
    monkeypatch.setattr(os, "replace", note_rename)
    with atomic_path(tmp_path / "a.txt") as temporary:
        temporary.write_text("text")
    assert steps == ["4 bytes", "rename", "folder"]


def test_an_outline_has_no_values_but_a_few(record: Record, tmp_path: Path) -> None:
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


def _open_to_edit(record: Record, path: Path) -> h5py.File:
    record.save(path)
    return h5py.File(path, "r+", libver=("v110", "v110"))


@pytest.mark.parametrize("rows", [1 << 38, 1 << 30])
def test_a_small_file_cannot_ask_for_terabytes(record: Record, rows: int, tmp_path: Path) -> None:
    with _open_to_edit(record, tmp_path / "a.h5") as file:
        file.create_dataset("huge", (rows,), np.float32, chunks=(1 << 20,), compression="gzip")
        file["huge"].attrs["units"] = file["huge"].attrs["axes"] = ""
    assert (tmp_path / "a.h5").stat().st_size < 20_000
    with pytest.raises(FileFormatError, match=r"'huge' claims \d+ bytes"):
        Record.load(tmp_path / "a.h5")


def test_chunks_are_bounded_too(record: Record, tmp_path: Path) -> None:
    with _open_to_edit(record, tmp_path / "a.h5") as file:
        huge = file.create_dataset(
            "huge", (4,), np.float32, chunks=(1 << 29,), maxshape=(None,), compression="gzip"
        )
        assert huge.chunks == (1 << 29,)
    with pytest.raises(FileFormatError, match="'huge' claims"):
        Record.load(tmp_path / "a.h5")


@pytest.mark.parametrize("kind", ["soft", "external", "external data", "virtual", "cycle", "text"])
def test_nothing_outside_the_file_is_followed(record: Record, kind: str, tmp_path: Path) -> None:
    (tmp_path / "secret").write_bytes(bytes(80))
    with h5py.File(tmp_path / "other.h5", "w") as other:
        other["x"] = np.ones(3)
    with _open_to_edit(record, tmp_path / "a.h5") as file:
        if kind == "soft":
            file["more"] = h5py.SoftLink("/counts")
        elif kind == "external":
            file["more"] = h5py.ExternalLink(str(tmp_path / "other.h5"), "x")
        elif kind == "external data":
            place = [(str(tmp_path / "secret"), 0, 80)]
            file.create_dataset("more", (10,), np.float64, external=place)
        elif kind == "virtual":
            layout = h5py.VirtualLayout((3,), np.float64)
            layout[:] = h5py.VirtualSource(str(tmp_path / "other.h5"), "x", (3,))
            file.create_virtual_dataset("more", layout)
        elif kind == "cycle":
            file["more"] = file["/"]
        else:
            file.create_dataset("more", data=["a", "b"], dtype=h5py.string_dtype())
    with pytest.raises(FileFormatError, match=r"a\.h5: .*(link|other files|deep|fixed size)"):
        Record.load(tmp_path / "a.h5")


def test_what_does_not_fit_into_memory_is_said(
    record: Record, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    record.save(tmp_path / "a.h5")

    def refuse(*_: object) -> None:
        raise MemoryError

    monkeypatch.setattr(h5py.Dataset, "__getitem__", refuse)
    with pytest.raises(StorageError, match="does not fit into this computer's memory"):
        Record.load(tmp_path / "a.h5")
