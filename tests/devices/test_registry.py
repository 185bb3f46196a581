"""Addresses, and the tables that say what they open."""

import re
from dataclasses import dataclass
from pathlib import Path

import pytest

import devices
from devices import registry
from devices.address import Options, Uri, option
from devices.source import Info, Source, Stats
from devices.transients import read_transient
from tofclip.errors import InputError

TABLE = (Path(__file__).parent / "refusals.txt").read_text(encoding="utf-8").splitlines()


class Nothing(Source):
    """A source at its end."""

    closed = False
    info = Info("nothing")
    stats = Stats()

    def read(self, timeout=0.0):
        return None

    def close(self):
        self.closed = True


@dataclass(frozen=True)
class NothingOptions(Options):
    seed: int = option(0)


def open_nothing(uri):
    NothingOptions.from_uri(uri)
    return Nothing()


@pytest.mark.parametrize("line", [line for line in TABLE if not line.startswith("#")])
def test_an_address_that_opens_nothing_says_why(line):
    address, said = line.split(" -> ")
    with pytest.raises(InputError) as caught:
        read_transient(address)
    message = str(caught.value)
    assert re.search(said, message)
    assert "\n" not in message


def test_a_codec_has_the_name_by_which_a_recording_asks_for_it():
    assert all(codec.name == name for name, codec in registry.CODECS.items())
    with pytest.raises(InputError, match="unknown codec 'absent'"):
        registry.build_codec("absent", {})


def test_a_scheme_opens_its_source(monkeypatch):
    """Its letters may be capital ones; what a source does not say itself is so by default."""
    monkeypatch.setitem(registry.SOURCES.registered, "nothing", open_nothing)
    with devices.open("NOTHING://?seed=1") as source:
        assert isinstance(source, Nothing)
        assert list(source) == []
        with pytest.raises(InputError, match="cannot seek"):
            source.seek(0)
    assert source.closed
    assert (source.is_live, source.is_seekable, source.calibration) == (False, False, None)
    with pytest.raises(InputError, match="'speed' is unknown; nothing takes seed"):
        devices.open("nothing://?speed=1")


def test_a_place_is_a_computer_and_a_port():
    assert Uri.parse("remoteex://lab-7:1001?seed=4").host_and_port(5) == ("lab-7", 1001)
    assert Uri.parse("tcp://[::1]").host_and_port(5) == ("::1", 5)
