"""Addresses, and the tables that say what they open."""

from __future__ import annotations

import inspect

import pytest

import devices
from devices import registry
from devices.address import Uri
from devices.source import Batch, Info, Source, Stats
from tofclip.errors import InputError


class Nothing(Source):
    """A source at its end."""

    closed = False
    info = Info("nothing")
    stats = Stats()

    def read(self, timeout: float = 0.0) -> Batch | None:
        return None

    def close(self) -> None:
        self.closed = True


def open_nothing(uri: Uri) -> Nothing:
    uri.reject_unknown("seed")
    return Nothing()


def test_public_names_are_importable() -> None:
    for name in devices.__all__:
        assert getattr(devices, name) is not None
    assert set(devices.__all__) <= set(dir(devices))
    with pytest.raises(AttributeError):
        _ = devices.absent


@pytest.mark.parametrize(
    "entry", [*registry.OPENERS.values(), *registry.FILE_OPENERS.values(), *registry.FINDERS]
)
def test_every_function_in_the_tables_exists(entry: str) -> None:
    assert callable(registry.import_entry(entry))


@pytest.mark.parametrize("name", registry.CODECS)
def test_every_codec_in_the_table_goes_by_its_name(name: str) -> None:
    codec = registry.import_entry(registry.CODECS[name])
    assert inspect.isclass(codec)
    assert vars(codec)["name"] == name


def test_a_scheme_opens_its_source(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(registry.OPENERS, "nothing", f"{__name__}:open_nothing")
    with devices.open("NOTHING://?seed=1") as source:
        assert isinstance(source, Nothing)
        assert list(source) == []
        with pytest.raises(InputError, match="cannot seek"):
            source.seek(0)
    assert source.closed
    assert not source.is_live
    assert not source.is_seekable
    assert source.calibration is None
    with pytest.raises(InputError, match="'speed' is unknown; nothing takes seed"):
        devices.open("nothing://?speed=1")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("run.h5", "not the address"),
        ("://x", "not the address"),
        ("absent://x", "no source is called 'absent'"),
        ("file://notes.txt", "must end in"),
        ("file://run.h5?a", "name=value"),
        ("file://run.h5?a=1&a=2", "twice"),
    ],
)
def test_an_unusable_address_is_said_so(text: str, said: str) -> None:
    with pytest.raises(InputError, match=said):
        devices.open(text)


def test_values_of_an_address_are_checked() -> None:
    uri = Uri.parse("remoteex://lab-7:1001?seed=4&pace=slow&rate=x")
    assert uri.host_and_port(5) == ("lab-7", 1001)
    assert uri.value("seed", int, 0) == 4
    assert uri.value("absent", int, 7) == 7
    assert uri.choice("mode", "a", "b") == "a"
    with pytest.raises(InputError, match="pace must be fast or realtime, got 'slow'"):
        uri.choice("pace", "fast", "realtime")
    with pytest.raises(InputError, match="rate cannot be 'x'"):
        uri.value("rate", float, 0.0)


@pytest.mark.parametrize("place", ["", ":5", "host:0", "host:99999", "host:x"])
def test_a_place_that_is_no_computer_is_refused(place: str) -> None:
    with pytest.raises(InputError):
        Uri.parse(f"tcp://{place}").host_and_port(1)


def test_an_unknown_codec_is_refused() -> None:
    with pytest.raises(InputError, match="no codec is called 'absent'"):
        registry.build_codec("absent", {})


def test_accounts_balance_or_do_not() -> None:
    assert Stats(15, 1, 2, 3, 4, 5).is_balanced
    assert not Stats(16, 1, 2, 3, 4, 5).is_balanced
    assert Stats(1, 1).as_dict()["delivered"] == 1
    assert Info("a tagger", "7", {"clock_hz": 5}).as_dict() == {
        "instrument": "a tagger",
        "serial": "7",
        "clock_hz": 5,
    }
    assert len(Batch(records=[])) == 0  # type: ignore[arg-type]
