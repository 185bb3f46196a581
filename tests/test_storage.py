"""Records survive their file; damaged files and full disks are named; writing is all or nothing;
declared fields come back, and what a file lacks is named or takes its default.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import stat
import subprocess
import sys
from dataclasses import is_dataclass, replace
from types import SimpleNamespace

import h5py
import hypothesis.extra.numpy as hnp
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tofclip.camera import Camera, PolynomialSweep, ProjectiveSweep, RangeCalibration, SkewSweep
from tofclip.errors import FileFormatError, StorageError
from tofclip.files import atomic_path, format_error_line
from tofclip.lidar import point_cloud
from tofclip.light_field import LightField
from tofclip.light_field.views import CameraSetup, measure
from tofclip.sequences.recovering import RangingPlan
from tofclip.shots import Frames, Returns, Streak
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
units, axes = st.sampled_from(["", "s", "m", "px"]), st.lists(names, max_size=3).map(tuple)
fields = st.dictionaries(names, st.builds(Field, arrays, units, axes), max_size=3)
attributes = st.dictionaries(words, scalars, max_size=4)
history = st.recursive(scalars, lambda s: st.lists(s, max_size=3), max_leaves=5)
# Fields and children share one group of the file, hence the upper-case names of the children.
leaves = st.builds(Record, words, fields, attributes)
children = st.dictionaries(names.map(str.upper), leaves, max_size=2)
records = st.builds(
    Record, words, fields, attributes, children, st.dictionaries(words, history, max_size=3)
)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "a.h5"


@pytest.fixture
def record():
    counts = Field(np.random.default_rng(1).random((40, 30)), "count", ("time", "column"))
    return Record("streak", {"counts": counts}, {"gain": 2.5, "name": "a"})


def open_to_edit(record, path):
    record.save(path)
    return h5py.File(path, "r+", libver=("v110", "v110"))


def assert_refused(path, problem=r"a\.h5", *kinds):
    with pytest.raises(FileFormatError, match=problem) as caught:
        Record.load(path, *kinds)
    assert "\n" not in str(caught.value)


def assert_same(got, expected):
    assert (got.kind, dict(got.attributes)) == (expected.kind, dict(expected.attributes))
    assert got.fields.keys() == expected.fields.keys()
    for name, entry in expected.fields.items():
        stored = got.fields[name]
        np.testing.assert_array_equal(stored.values, entry.values)
        assert stored.values.dtype == entry.values.dtype
        assert (stored.units, stored.axes) == (entry.units, entry.axes)
    assert got.children.keys() == expected.children.keys()
    for name, child in expected.children.items():
        assert_same(got.children[name], child)


class TestRecord:
    @settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
    @given(expected=records)
    def test_a_record_survives_its_file(self, expected, path):
        expected.save(path)
        got = Record.load(path)
        assert_same(got, expected)
        assert (got.provenance, got.origin) == (expected.provenance, str(path))

    @pytest.mark.parametrize("shape", [(300, 200), (70, 40, 50)])
    def test_large_arrays_are_compressed_without_loss(self, shape, path):
        values = np.zeros(shape, np.float32)
        values[::7] = np.random.default_rng(0).random(values[::7].shape)
        Record("frames", {"values": Field(values)}).save(path)
        np.testing.assert_array_equal(Record.load(path).fields["values"].values, values)
        assert path.stat().st_size < values.nbytes / 2

    def test_text_longer_than_an_hdf5_attribute_survives(self, path):
        long = "é" * 70_000
        Record("x", attributes={"long": long}, provenance={"history": long}).save(path)
        got = Record.load(path)
        assert got.attributes["long"] == got.provenance["history"] == long

    def test_attributes_and_children_are_checked(self, record):
        parent = Record("frames", children={"shot": record})
        assert record.attribute("gain") == 2.5
        assert record.attribute("absent", 7) == 7
        assert parent.child("shot", "streak") is record
        with pytest.raises(FileFormatError, match="no attribute 'absent'"):
            record.attribute("absent")
        for name in ("shot", "camera"):
            with pytest.raises(FileFormatError, match=f"carries no camera '{name}'"):
                parent.child(name, "camera")

    def test_a_number_is_finite_and_what_is_found_stays_on_one_line(self):
        odd = {"text": "a\nb", "none": np.inf, "some": np.int64(3)}
        record = Record("thing", {}, odd, origin="x.h5")
        assert record.number("some") == record.number("absent", 3.0) == 3.0
        for name in ("text", "none"):
            with pytest.raises(FileFormatError, match=r"must be a number, found (a b|inf)$"):
                record.number(name)
        with pytest.raises(FileFormatError, match="has no attribute 'absent'"):
            record.number("absent")

    def test_an_outline_has_no_values_but_a_few(self, record, path):
        added = {
            "few": Field(np.arange(3.0), "px", ("view",)),
            "large": Field(np.random.default_rng(0).random((300, 400)), "m", ("y", "x")),
        }
        record = replace(record, fields={**record.fields, **added})
        record.save(path)
        outline = read_outline(path).fields
        assert set(outline) == set(record.fields)
        assert is_stand_in(outline["large"].values)
        assert (outline["large"].values.shape, outline["large"].axes) == ((300, 400), ("y", "x"))
        for name, entry in record.fields.items():
            if entry.values.size <= MAX_OUTLINE_VALUES:
                np.testing.assert_array_equal(outline[name].values, entry.values)
                assert not is_stand_in(outline[name].values)


class TestDamage:
    """HDF5 reads some damaged files for ever and others as if nothing were wrong; checksums prevent
    both.
    """

    def damage(self, path, positions):
        whole = path.read_bytes()
        for position in positions:
            damaged = bytearray(whole)
            damaged[int(position * len(whole))] ^= 0x41
            path.write_bytes(damaged)
            assert_refused(path)

    def test_no_damaged_byte_goes_unnoticed(self, record, path):
        record.save(path)
        self.damage(path, np.random.default_rng(2).random(150))

    @pytest.mark.parametrize("compressed", [True, False])
    def test_no_damaged_byte_of_a_large_array_goes_unnoticed(self, compressed, path):
        values = np.random.default_rng(0).random((70, 40, 40), np.float32)
        Record("frames", {"values": Field(values)}).save(path, compressed)
        self.damage(path, np.linspace(0.2, 0.8, 9))  # where nothing but the array is

    @pytest.mark.parametrize("share", [0.05, 0.5, 0.999])
    def test_a_truncated_file_is_refused(self, record, share, path):
        record.save(path)
        os.truncate(path, int(path.stat().st_size * share))
        assert_refused(path, r"a\.h5: is (damaged|not an HDF5)")

    def test_what_is_no_record_is_named(self, record, path, tmp_path):
        path.touch()
        assert_refused(path, "is empty")
        path.write_text("not HDF5")
        assert_refused(path, "is not an HDF5 file")
        with pytest.raises(FileFormatError, match=r"expected frames \(run tofclip recover first\)"):
            Record.load(path, "frames")
        with h5py.File(path, "w") as file:
            file["data"] = [1.0]
        assert_refused(path, "not one of tofclip's")
        for place, problem in ((tmp_path / "absent.h5", "no such file"), (tmp_path, "is a folder")):
            with pytest.raises(StorageError, match=problem):
                Record.load(place)
        with open_to_edit(record, path) as file:
            file.attrs["format_version"] = 99
        assert_refused(path, "format version 99")
        with open_to_edit(record, path) as file:
            file.attrs["provenance"] = "by hand"
        assert_refused(path, "provenance is not JSON")
        record.save(path)
        assert Record.load(path, "frames", "streak").kind == "streak"
        expected = "holds a streak record, expected camera or frames"
        assert_refused(path, expected, "camera", "frames")

    @pytest.mark.parametrize(
        "value",
        [np.zeros(5), np.zeros((2, 3), np.int32), h5py.Empty("f8"), 1j, np.bytes_(b"\xff\xfe z")],
        ids=["list", "table", "empty", "complex", "no text"],
    )
    @pytest.mark.parametrize("name", ["format_version", "kind", "value.number"])
    def test_an_attribute_is_text_or_a_number(self, name, value, path):
        with open_to_edit(Record("thing", {}, {"number": 3}), path) as file:
            file.attrs[name] = value
        for read in (Record.load, read_outline):
            with pytest.raises(FileFormatError) as caught:
                read(path)
            assert "\n" not in str(caught.value)

    @pytest.mark.parametrize("rows", [1 << 38, 1 << 30])
    def test_a_small_file_cannot_ask_for_terabytes(self, record, rows, path):
        with open_to_edit(record, path) as file:
            settings = {"chunks": (1 << 20,), "compression": "gzip"}
            huge = file.create_dataset("huge", (rows,), np.float32, **settings)
            huge.attrs["units"] = huge.attrs["axes"] = ""
        assert path.stat().st_size < 20_000
        assert_refused(path, r"'huge' claims \d+ bytes")

    def test_chunks_are_bounded_too(self, record, path):
        with open_to_edit(record, path) as file:
            settings = {"chunks": (1 << 29,), "maxshape": (None,), "compression": "gzip"}
            huge = file.create_dataset("huge", (4,), np.float32, **settings)
            assert huge.chunks == (1 << 29,)
        assert_refused(path, "'huge' claims")

    @pytest.mark.parametrize(
        "kind", ["nowhere", "soft", "external", "external data", "virtual", "cycle", "text"]
    )
    def test_nothing_outside_the_file_is_followed(self, record, kind, path, tmp_path):
        (tmp_path / "secret").write_bytes(bytes(80))
        other = str(tmp_path / "other.h5")
        with h5py.File(other, "w") as file:
            file["x"] = np.ones(3)
        with open_to_edit(record, path) as file:
            if kind == "nowhere":
                file["more"] = h5py.SoftLink("/nowhere")
            elif kind == "soft":
                file["more"] = h5py.SoftLink("/counts")
            elif kind == "external":
                file["more"] = h5py.ExternalLink(other, "x")
            elif kind == "external data":
                place = [(str(tmp_path / "secret"), 0, 80)]
                file.create_dataset("more", (10,), np.float64, external=place)
            elif kind == "virtual":
                layout = h5py.VirtualLayout((3,), np.float64)
                layout[:] = h5py.VirtualSource(other, "x", (3,))
                file.create_virtual_dataset("more", layout)
            elif kind == "cycle":
                file["more"] = file["/"]
            else:
                file.create_dataset("more", data=["a", "b"], dtype=h5py.string_dtype())
        problem = (
            "'more' cannot be read" if kind == "nowhere" else "link|other files|deep|fixed size"
        )
        assert_refused(path, rf"a\.h5: .*({problem})")

    def test_what_does_not_fit_into_memory_is_said(self, record, path, monkeypatch):
        record.save(path)

        def refuse(*_):
            raise MemoryError

        monkeypatch.setattr(h5py.Dataset, "__getitem__", refuse)
        with pytest.raises(StorageError, match="does not fit into this computer's memory"):
            Record.load(path)

    def test_another_librarys_message_is_one_line_of_readable_length(self):
        assert format_error_line(ValueError("a\n b")) == "a b"
        assert format_error_line(ValueError()) == "ValueError"
        assert len(format_error_line(ValueError("(" * 6000))) < 210


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


class TestWriting:
    @pytest.mark.parametrize("fault", [ValueError, KeyboardInterrupt, OSError, StorageError])
    def test_an_interrupted_write_leaves_the_old_file(self, fault, tmp_path):
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

    def test_the_file_is_replaced_at_the_end_only_with_contents_on_the_disk_before_the_name(
        self, tmp_path, monkeypatch
    ):
        target, plain = tmp_path / "scene.ply", tmp_path / "plain"
        target.write_text("old")
        plain.touch()
        steps = []
        sync, rename = os.fsync, os.replace

        def note_sync(handle):
            status = os.fstat(handle)
            steps.append("folder" if stat.S_ISDIR(status.st_mode) else f"{status.st_size} bytes")
            sync(handle)

        def note_rename(source, target):
            steps.append("rename")
            rename(source, target)

        monkeypatch.setattr(os, "fsync", note_sync)
        monkeypatch.setattr(os, "replace", note_rename)
        # The umask belongs to the whole process.
        monkeypatch.setattr(os, "umask", lambda _: pytest.fail("the umask was asked for"))
        with atomic_path(target) as temporary:
            temporary.write_text("new text")
            assert target.read_text() == "old"
            assert (temporary.suffix, temporary.parent) == (".ply", tmp_path)
        assert steps == ["8 bytes", "rename", "folder"]
        assert target.read_text() == "new text"
        assert {*os.listdir(tmp_path)} == {"scene.ply", "plain"}
        # The permissions of any new file.
        assert target.stat().st_mode == plain.stat().st_mode

    def test_unwritable_places_are_named(self, record, tmp_path):
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

    def test_forbidden_places_are_named(self, record, path, monkeypatch):
        def refuse(*_, **__):
            raise PermissionError(13, "Permission denied")

        monkeypatch.setattr("os.open", refuse)
        unwritable = r"a\.h5: cannot be written: writing is not permitted there"
        with pytest.raises(StorageError, match=unwritable):
            record.save(path)
        monkeypatch.setattr("builtins.open", refuse)
        with pytest.raises(StorageError, match=r"a\.h5: reading is not permitted"):
            Record.load(path)

    @pytest.mark.skipif(os.name != "posix", reason="needs a limit on the size of files")
    def test_a_full_disk_is_an_error_and_leaves_nothing(self, path, tmp_path):
        """A limit on file size stands for the full disk: the write fails half way. HDF5 itself
        would crash.
        """
        path.write_text("old")
        command = [sys.executable, "-c", FULL_DISK, str(path)]
        child = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
        assert (child.returncode, child.stderr) == (0, "")
        assert child.stdout.startswith(f"{path}: cannot be written: the disk is full")
        assert path.read_text() == "old"
        assert os.listdir(tmp_path) == ["a.h5"]

    @pytest.mark.parametrize(
        "fault", [RuntimeError("code C20"), OSError("9 requested and 3 written")]
    )
    @pytest.mark.parametrize("free", [0, 1 << 30])
    def test_a_librarys_own_error_on_a_full_disk_is_named(self, tmp_path, monkeypatch, fault, free):
        monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=free))
        expected = StorageError if free == 0 or isinstance(fault, OSError) else RuntimeError

        def write_half():
            with atomic_path(tmp_path / "scene.e57") as temporary:
                temporary.write_bytes(b"half")
                raise fault

        with pytest.raises(expected, match="the disk is full" if free == 0 else str(fault)):
            write_half()
        assert list(tmp_path.iterdir()) == []

    def test_provenance_names_the_inputs(self, tmp_path):
        (tmp_path / "in.tif").write_bytes(b"pixels")
        found = collect_provenance({"iterations": 3}, tmp_path / "in.tif", tmp_path / "absent")
        digest = hashlib.sha256(b"pixels").hexdigest()
        assert found["settings"] == {"iterations": 3}
        assert found["inputs"] == [{"name": "in.tif", "sha256": digest}]
        assert found["software"].startswith("tofclip ")
        assert found["created"].endswith("+00:00")


NUMBERS = np.random.default_rng(0).random((4, 5, 6)).astype(np.float32)
TIMES = np.array([10.0, 11.0, 13.0, 16.0]) * 1e-12
SWEEPS = (
    SkewSweep([8.0, 21.5], [0.5, -1.0], [0.0, 0.01]),
    PolynomialSweep(np.arange(6.0), np.ones(6), *np.arange(1.0, 9.0).reshape(4, 2)),
    ProjectiveSweep(np.eye(3) + 0.1),
)
LENSES = {"focal_length_px": 400.5, "lenslet_pitch": 5e-3, "focus_distance": 1.6}
TIMING = {"time_zero": -1.5e-9, "pulse_fwhm": 7e-11, "dead_columns": np.arange(30) == 17}
DOUBTS = {"centre_uncertainty_px": [0.1, 0.2], "angle_uncertainty": [0.01, 0.02]}
VIEWS = [8.0, 21.5], [0.1, -0.2], (5, 6), 30, [0.9, 1.1], [-0.4, 0.7]
CAMERA = Camera(*VIEWS, **LENSES, **TIMING, **DOUBTS)
WALK = np.array([2e-3]), np.array([[9e-8]]), 10.0, np.array([10.0, 1e5])
KNOWN = RangeCalibration(1e-12, *WALK, NUMBERS[0], NUMBERS[1], NUMBERS[2] + 0.1, 0.5, 0.01)
RETURNS = Returns(
    *np.array([[1, 1, 3], [0, 0, 4]], np.int32),
    *(1.5e8 * TIMES[:3], NUMBERS[0, 0, :3], NUMBERS[0, 1, :3], np.array([1, 2, 1], np.uint8)),
    *(TIMES[:3], CAMERA, {"by": "test"}, np.full(3, -0.5), np.full(3, 0.1)),
)
WALL = {"relay_wall": Record("relay_wall", {"laser": Field(np.ones(3), "m")}, {"row_offset": 25})}
TEXTS = {"Streak camera/Time Range": "20 ns", "Comment/UserComment": "", "é": "µs\n"}
LIGHT_FIELD = LightField(NUMBERS, np.array([(v, u) for v in (-1.0, 0) for u in (-1.0, 0)]))
STORED = {
    "camera": CAMERA,
    **{type(sweep).__name__: CAMERA.replace(sweep=sweep) for sweep in SWEEPS},
    "calibrated camera": CAMERA.replace(range_calibration=KNOWN),
    "bare camera": Camera([8.0], [0.1], (5, 6), 30, distortion=[-9.0, 0, 0, 0, 0.1]),
    "streak": Streak(
        NUMBERS[0], TIMES.repeat(2)[:5].cumsum(), NUMBERS[0] > 0.5, TEXTS, CAMERA, WALL
    ),
    "bare streak": Streak(NUMBERS[0]),
    "frames": Frames(
        *(NUMBERS, TIMES, CAMERA, {"residual": 0.08, "method": "tv", "iterations": 60}, WALL),
        *({"settings": {"seed": 1}}, np.linspace(-1, 0, 4), replace(RETURNS, provenance={})),
    ),
    "returns": RETURNS,
    "cloud": point_cloud(RETURNS),
    "light field": LIGHT_FIELD,
    **{name: measure(LIGHT_FIELD, CameraSetup(name, 0.9, 7)) for name in ("line", "single-pixel")},
    "plan": RangingPlan(CAMERA, TIMES, np.arange(4.0), "depth-locked"),
}


def assert_alike(got, expected):
    """Of objects as they are in memory: what is stored of both might lack the same."""
    assert type(got) is type(expected)
    if isinstance(expected, Record):
        assert_same(got, expected)
    elif is_dataclass(expected):
        for name in set(vars(expected)) - {"source"}:
            assert_alike(getattr(got, name), getattr(expected, name))
    elif isinstance(expected, dict):
        assert got.keys() == expected.keys()
        for name, value in expected.items():
            assert_alike(got[name], value)
    else:
        np.testing.assert_array_equal(got, expected)
        assert getattr(got, "dtype", None) == getattr(expected, "dtype", None)


class TestStorables:
    @pytest.mark.parametrize("name", STORED)
    def test_all_of_it_survives_its_file(self, name, path):
        STORED[name].save(path)
        back = type(STORED[name]).load(path)
        assert_alike(back, STORED[name])
        assert getattr(back, "source", str(path)) == str(path)

    def test_what_is_optional_may_be_absent(self):
        record = CAMERA.to_record()
        assert set(Streak(NUMBERS[0]).to_record().fields) == {"counts"}
        attributes = {k: v for k, v in record.attributes.items() if k != "focus_distance_m"}
        assert Camera.from_record(replace(record, attributes=attributes)).focus_distance == np.inf

    @pytest.mark.parametrize(
        ("change", "message"),
        [
            ({"fields": {}}, "no field 'centres'"),
            ({"attributes": {}}, "no attribute 'slit_width_px'"),
            ({"attributes": {"slit_width_px": "many"}}, "'slit_width_px' must be of type int"),
            ({"fields": {"centres": Field(np.ones(2), "s")}}, "must be in 'px'"),
            ({"fields": {"centres": Field(np.ones((3, 2)), "px")}}, "must have 1 dimension"),
            ({"fields": {"image_shape": Field(np.ones(2), "px")}}, "must convert to int64, found"),
        ],
    )
    def test_what_is_declared_must_be_there(self, change, message):
        record = CAMERA.to_record()
        old = {"fields": record.fields, "attributes": record.attributes}
        new = {name: {**old[name], **one} if one else one for name, one in change.items()}
        with pytest.raises(FileFormatError, match=message):
            Camera.from_record(replace(record, **new))
