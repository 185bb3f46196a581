"""Several sources in one scene, and how something is looked at in a file."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from viewer_scenes import NEAR_FRAME, frames, plane, volume

from apps.cli import main
from apps.viewer.session import Filters, Section, Session, read_state, restore_state, write_state
from apps.viewer.source import LayeredSource
from apps.viewer.source_factory import open_source
from apps.viewer.sources import GATE_AROUND_FRAME, TransientSource
from apps.viewer.viewpoint import Viewpoint
from tofclip.errors import FileFormatError


@pytest.fixture
def paths(tmp_path):
    """Frames, a cloud and a volume."""
    named = {"frames.h5": frames(), "cloud.ply": plane(40), "volume.h5": volume()}
    for name, one in named.items():
        one.save(tmp_path / name)
    return [str(tmp_path / name) for name in named]


def open_layers(paths):
    source = LayeredSource([open_source(path) for path in paths])
    return source, Session(source)


def test_layers_are_shown_together_each_on_and_off_and_moved_aside(paths):
    source, session = open_layers(paths)
    whole = session.frame_at(0.0)
    sizes = np.bincount(whole.layers)[1:].tolist()
    assert sizes[:2] == [85, 40]
    assert sizes[2] > 10
    # time passes for the frames only: a file of points has all of them at any time
    session.clock.jump(0)
    assert np.unique(session.frame_at(0.0).layers).tolist() == [2, 3]
    session.clock.jump(len(source))
    source.switches[0].value = source.switches[2].value = "off"
    alone = session.frame_at(0.0)
    assert alone.layers.tolist() == [2] * 40
    before = alone.cloud.xyz
    source.shifts[1].value = 1.0
    width = np.ptp(whole.cloud.xyz[whole.layers == 1, 0])
    moved = session.frame_at(0.0).cloud.xyz - before
    assert moved == pytest.approx(np.tile([width, 0, 0], (40, 1)), abs=1e-5)
    source.switches[1].value = "off"
    assert len(session.frame_at(0.0).cloud) == 0
    assert {"1 streak", "2 depth", "3 intensity"} - set(source.pictures(0)) == {"2 depth"}


def test_layers_with_times_of_their_own_are_shown_at_one_instant():
    whole, later = TransientSource("whole", frames()), TransientSource("later", frames()[10:])
    for one in (whole, later):
        one.gate.value, one.half_gate.value = GATE_AROUND_FRAME, 5
    session = Session(LayeredSource([whole, later]))
    session.clock.jump(NEAR_FRAME)
    assert np.bincount(session.frame_at(0.0).layers).tolist() == [0, 36, 36]


def test_a_pick_reads_the_waveform_of_its_own_layer(paths):
    _, session = open_layers(paths[1::-1])
    shown = session.frame_at(0.0)
    for layer, has_waveform in ((1, False), (2, True)):
        pick = session.pick((0, 0, 0), shown.cloud.xyz[shown.layers == layer][0])
        assert (pick.waveform is not None) is has_waveform


def test_a_state_brings_back_what_was_seen_also_beside_moved_files(paths, tmp_path, capsys):
    source, session = open_layers(paths)
    session.opened = {"sources": paths, "options": {}}
    source.settings[2].value = GATE_AROUND_FRAME
    session.clock.jump(30)
    session.colouring = replace(session.colouring, quantity="layer", limits=(0.0, 3.0))
    session.filters = Filters({"x": (-0.4, 0.4)}, Section((0.0, 0.0, 1.0), 1.8, 0.6))
    session.viewpoint = Viewpoint(np.array([0.0, 0, -1]), np.array([0.0, 0, 2]), 0.5)
    before, state = session.frame_at(0.0), tmp_path / "state.json"
    state.write_text(write_state(session, session.viewpoint))
    moved = tmp_path / "moved"
    moved.mkdir()
    for path in (*paths, state):
        Path(path).rename(moved / Path(path).name)
    known = read_state(moved / "state.json")
    _, again = open_layers(known["sources"])
    restore_state(again, known, state)
    assert np.array_equal(again.frame_at(0.0).cloud.xyz, before.cloud.xyz)
    assert np.array_equal(again.frame_at(0.0).colours, before.colours)
    assert (again.clock.frame, again.viewpoint.field_of_view) == (30, 0.5)
    (moved / "other.json").write_text(json.dumps({"kind": "something"}))
    for name, words in (("other.json", "is not a state"), ("state.json", "does not fit")):
        text = (moved / name).read_text().replace('"range"', '"no such"')
        (moved / name).write_text(text.replace('"up to', '"no').replace('"colouring"', '"lost"'))
        assert main(["view", str(moved / name), "--png", str(tmp_path / "a.png")]) == 2
        assert words in capsys.readouterr().err
    with pytest.raises(FileFormatError):
        read_state(moved / "other.json")
