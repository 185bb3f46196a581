"""Cameras behind TCP: RemoteEx's and the SPAD512's messages, and the drivers against emulated cameras
and scripted servers that can fail.
"""

import socket
import string
import threading
import time
from contextlib import contextmanager
from dataclasses import replace
from itertools import pairwise

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given
from instruments import finish, read_gaps, take
from numpy.testing import assert_allclose, assert_array_equal

import devices
from devices.emulation.harness import HOST, Fault, LoopbackServer
from devices.emulation.remoteex import EmulatedStreakCamera
from devices.emulation.scenes import (
    EmulatedLight,
    render_array_delays,
    render_array_light,
    simulate_light,
)
from devices.emulation.spad512 import EmulatedSpadArray
from devices.remoteex import (
    REFUSALS,
    TERMINATOR,
    Answer,
    AnswerCode,
    Command,
    RemoteExClient,
)
from devices.spad512 import BIT_DEPTHS, IMAGE_WIDTHS_PX, ROWS, SpadOptions
from devices.tcp import TcpLink
from devices.transients import read_photons
from tofclip.camera import Camera
from tofclip.errors import (
    DeviceBusyError,
    DeviceDisconnectedError,
    DeviceError,
    DeviceNotFoundError,
    DeviceTimeoutError,
    InputError,
    ProtocolError,
)

LIGHT = EmulatedLight(
    np.random.default_rng(1).uniform(0, 50, (12, 20)),
    np.cumsum(np.linspace(18e-12, 20e-12, 12)),
    full_scale=60,
    seed=3,
)
ARRAY_LIGHT = np.random.default_rng(2).uniform(0, 2e5, (ROWS, ROWS))
DELAYS_S = np.full((ROWS, ROWS), 8e-9)


@contextmanager
def switched_off_in_the_end():
    made = []
    yield made
    for server in made:
        server.close()


@pytest.fixture
def camera():
    """Make emulated streak cameras with these faults, which differ in attributes of their class."""
    with switched_off_in_the_end() as made:

        def make(*faults, rate=100.0, **unlike):
            made.append(type("Camera", (EmulatedStreakCamera,), unlike)(LIGHT, rate, 1000, faults))
            return made[-1]

        yield make


@pytest.fixture
def array():
    """Make emulated SPAD arrays, likewise."""
    with switched_off_in_the_end() as made:

        def make(*faults, light=ARRAY_LIGHT, delays=None, **unlike):
            kind = type("Array", (EmulatedSpadArray,), unlike)
            made.append(kind(light, 7, faults=faults, delays=delays))
            return made[-1]

        yield make


def opened(server, **values):
    """Open the driver of an emulated or scripted server."""
    if isinstance(server, EmulatedStreakCamera):
        port, values["data_port"] = server.ports
        address = f"remoteex://{HOST}:{port}"
    else:
        address, values = f"spad512://{HOST}:{server.port}", {"width": 64, **values}
    return devices.open(f"{address}?" + "&".join(f"{name}={values[name]}" for name in values))


def require_pictures(frames):
    """Require the streak camera's pictures, bit for bit, by their numbers."""
    for frame in frames:
        assert_array_equal(frame["counts"], LIGHT.draw_frame(int(frame["number"])))


# What drivers of both have in common


@pytest.fixture(params=["camera", "array"])
def either(request):
    return request.getfixturevalue(request.param)


def test_after_an_unplugged_cable_the_stream_goes_on(either):
    with opened(either(Fault(5, "unplug"))) as source:
        gaps = read_gaps(source, 20)
        finish(source)
    assert (source.stats.reconnects, gaps.count(True)) == (1, 1)


def test_late_answers_are_waited_for_and_not_asked_for_again(either):
    """Later than the time to wait: the picture comes all the same, and no other is taken for it."""
    server = either(Fault(3, "timeout", 5), Fault(6, "short", 5))
    is_streak_camera = isinstance(server, EmulatedStreakCamera)
    with opened(server, timeout_s=0.2 if is_streak_camera else 5) as source:
        frames = take(source, 15)
        finish(source)
    assert source.stats.timeouts >= 2
    assert source.stats.reconnects == 0
    if is_streak_camera:
        require_pictures(frames)
    else:
        assert [int(frame["number"]) for frame in frames] == list(range(len(frames)))


def test_one_that_stays_away(either):
    server = either()
    with opened(server, reconnect_s=0.3) as source:
        take(source, 1)
        server.close()
        with pytest.raises(DeviceDisconnectedError, match=r"no answer came for 0\.3 s"):
            take(source, 10_000)
    assert source.stats.is_balanced


@pytest.mark.parametrize("scheme", ["remoteex", "spad512"])
def test_nobody_there(scheme):
    with pytest.raises(DeviceNotFoundError, match="is its program running"):
        devices.open(f"{scheme}://{HOST}:1")


@pytest.mark.parametrize("kind", ["corrupt", "overflow", "stall"])
def test_after_nonsense_the_stream_ends_and_the_gain_is_down(either, kind):
    """A picture larger than any is refused before memory is taken."""
    try:
        server = either(Fault(3, kind))
    except InputError:
        return  # not one of its faults
    values = {"mcp_gain": 20} if isinstance(server, EmulatedStreakCamera) else {}
    with opened(server, **values) as source, pytest.raises(DeviceError):
        take(source, 100)
    assert getattr(server, "gain", "0") == "0"
    assert source.stats.is_balanced


def test_no_thread_is_left_behind(either):
    before = threading.active_count()
    server = either()
    with opened(server) as source:
        take(source, 3)
    server.close()
    deadline = time.monotonic() + 5
    while threading.active_count() > before and time.monotonic() < deadline:
        time.sleep(0.05)
    assert threading.active_count() <= before


def test_servers_are_for_this_computer_only():
    with LoopbackServer(lambda connection: None) as server:
        assert server.server_address[0] == HOST
        others = socket.getaddrinfo(socket.gethostname(), None, socket.AF_INET)
        for address in {str(entry[4][0]) for entry in others} - {HOST}:
            with pytest.raises(OSError, match="refused"):
                socket.create_connection((address, server.port), 1)


# RemoteEx's messages

names = st.text(string.ascii_letters, min_size=1, max_size=20)
letters = st.sampled_from(
    [chr(n) for n in (*range(32, 127), *range(160, 256)) if chr(n) not in ",()"]
)
arguments = st.lists(st.text(letters, max_size=9), max_size=5).filter(lambda words: words != [""])


@given(st.sampled_from(AnswerCode), names, arguments)
def test_messages_come_back(code, name, words):
    for message in (Answer(code, name, tuple(words)), Command(name, tuple(words))):
        assert type(message).decode(message.encode().removesuffix(TERMINATOR)) == message


@pytest.mark.parametrize(
    ("message", "sent"),
    [
        (Command("DevParamSet", ("TD", "MCP Gain", "0")), b"DevParamSet(TD,MCP Gain,0)"),
        (Command("DevParamSet", ("TD", "10 µs")), b"DevParamSet(TD,10 \xb5s)"),  # Latin-1
        (Command("AcqStop"), b"AcqStop()"),
        (Answer(AnswerCode.DONE, "DevParamGet", ("10 µs",)), b"0,DevParamGet,10 \xb5s"),
        (Answer(AnswerCode.MESSAGE, "LiveMonitor", ("14",)), b"4,LiveMonitor,14"),
    ],
)
def test_messages_as_the_handbook_writes_them(message, sent):
    assert message.encode() == sent + b"\r"
    assert type(message).decode(sent) == message


@pytest.mark.parametrize("words", [("a,b",), ("(",), ("a\r",), ("",), ("Ω",)])
def test_what_the_protocol_cannot_carry(words):
    for message in (Command("AcqStart", words), Answer(AnswerCode.DONE, "Acq Start")):
        with pytest.raises(InputError):
            message.encode()


@pytest.mark.parametrize(
    "message",
    [b"", b"0", b"0,", b"11,Name", b"x,Name", b"-1,Name", b"\xff\xfe", b"\xb2,Name", b"0,A\nB"],
)
def test_answers_that_are_none(message):
    with pytest.raises(ProtocolError):
        Answer.decode(message)


@pytest.mark.parametrize("code", REFUSALS)
def test_every_refusal_is_explained(code):
    with pytest.raises(DeviceError, match=r"refused AcqStart\(Live\): .*\(why\)") as caught:
        Answer(code, "AcqStart", ("why",)).require_done(Command("AcqStart", ("Live",)))
    assert isinstance(caught.value, DeviceBusyError) == (code is AnswerCode.NOT_NOW)


@contextmanager
def scripted(data=b"", greeting=b"RemoteEx Ready\r", **answers):
    """Connect to a server that answers each request by a script, and an unknown one not at all."""

    def serve(connection):
        connection.send(greeting)
        while (request := connection.read_request(TERMINATOR)) is not None:
            connection.send(answers.get(request.decode(), b""))

    def serve_data(connection):
        connection.send(b"RemoteEx Data Ready\r")
        time.sleep(0.1)  # what comes before the question is thrown away
        connection.send(data)
        connection.read_request(TERMINATOR)

    with LoopbackServer(serve) as commands, LoopbackServer(serve_data) as pictures:
        link = RemoteExClient(HOST, commands.port, pictures.port, 0.5)
        yield link
        link.close()


@pytest.mark.parametrize(
    ("answer", "problem"),
    [
        (b"0,ImgRingBufferGet\r", "described a picture by 0 words"),
        (b"0,ImgRingBufferGet,a,2,2,0,0\r", "expected a whole number"),
        (b"0,ImgRingBufferGet,2,2,3,0,0\r", "pixels of 3 bytes"),
        (b"0,ImgRingBufferGet,99999999,99999999,2,0,0\r", "at most"),
        (b"0,ImgRingBufferGet,2,2,1,0,x\r", "expected a whole number"),
        (b"0,Other,2,2,1,0,0\r", "answered Other when asked"),
        (b"x" * 70000, "without the end"),
    ],
)
def test_answers_about_pictures_that_make_no_sense(answer, problem):
    with (
        scripted(b"pixels", **{"ImgRingBufferGet(Data,0)": answer}) as link,
        pytest.raises(ProtocolError, match=problem),
    ):
        link.read_frame(0)


def test_messages_are_kept_while_an_answer_is_awaited():
    with scripted(**{"AcqStop()": b"4,LiveMonitor,RingBuffer,1\r0,AcqStop\r"}) as link:
        assert link.ask("AcqStop") == ()
        assert link.read_message(1).arguments == ("RingBuffer", "1")
        with pytest.raises(DeviceTimeoutError):
            link.read_message(0.05)
        # Then its answer is owed: nothing else is sent before that has come.
        for name in ("AcqStart", "AcqStop"):
            with pytest.raises(DeviceTimeoutError, match=r"AcqStart\(\) .*it is not asked again"):
                link.ask(name)


def test_an_error_of_several_lines_does_not_shift_the_answers():
    answers = {
        "AcqStart(Live)": b"7,AcqStart,raw\rdata \xb5\r\nmore\r",
        "AcqStatus()": b"5,HAcq: odd\rtext\r0,acqstatus,idle\r",
    }
    with scripted(**answers) as link:
        assert not link.is_done("AcqStart", "Live")
        assert link.ask("AcqStatus") == ("idle",)


@pytest.mark.parametrize("greeting", [b"SSH-2.0\r", b"RemoteEx Data Ready\r"])
def test_another_server_is_recognised(greeting):
    with (
        pytest.raises(ProtocolError, match="expected 'RemoteEx Ready'"),
        scripted(greeting=greeting),
    ):
        pass
    with LoopbackServer(lambda connection: connection.send(b"RemoteEx Ready\r")) as server:
        with pytest.raises(ProtocolError, match="expected 'RemoteEx Data Ready'"):
            RemoteExClient(HOST, server.port, server.port, 2)
        with pytest.raises(DeviceNotFoundError):
            RemoteExClient(HOST, server.port, 1, 2)


# The streak camera


def test_pictures_come_in_order_and_bit_for_bit(camera):
    """And everything that is known of the camera."""
    server = camera()
    with opened(server, mcp_gain=30, time_range="100 ns") as source:
        assert server.gain == "30"
        info, known = source.info.as_dict(), source.calibration
        frames = take(source, 12)
        finish(source)
    numbers = [int(frame["number"]) for frame in frames]
    assert numbers == list(range(numbers[0], numbers[0] + 12))
    require_pictures(frames)
    assert server.gain == "0"
    assert (info["time_range"], info["mode"]) == ("100 ns", "Operate")
    assert (info["rows"], info["columns"]) == (12, 20)
    assert known is not None
    # float32 numbers in ns, as the camera sends them.
    assert_allclose(known.array("row_times", float, 1, "s"), LIGHT.row_times, rtol=1e-7)


@pytest.mark.parametrize(
    "unlike",
    [
        {"is_application_up": False},  # HPD-TA is started
        {"busy_for": 3},  # waited for
        {"busy_for": 10**9},  # stopped
        {"stray_bytes": 1000},  # on the data port, thrown away
    ],
    ids=str,
)
def test_a_camera_as_others_left_it(camera, unlike):
    server = camera(**unlike)
    with opened(server, mcp_gain=9, timeout_s=0.5) as source:
        require_pictures(take(source, 3))
        assert server.gain == "9"


def test_live_mode_of_an_operator_is_joined_and_goes_on(camera):
    server = camera(is_live=True, rate=200.0)
    server.gain = "13"
    time.sleep(0.05)
    with opened(server, mcp_gain=20) as source:
        frames = take(source, 5)
        assert server.gain == "20"
    assert frames[0]["number"] > 0
    assert server.is_running
    assert server.gain == "13"


# Of the fast one many pictures are announced before a client asks, in vain, for one of them.
@pytest.mark.parametrize(("rate", "last"), [(100.0, 20), (5000.0, 300)])
def test_numbers_that_restart_are_followed(camera, rate, last):
    numbers, gaps, falls = [], [], []
    with opened(camera(restart_at=last, rate=rate), buffers=4096) as source:
        while not any(falls):
            batch = source.read(5)
            assert batch is not None
            numbers += batch.records["number"].tolist()
            gaps += [batch.after_gap] * len(batch)
            falls = [later < number for number, later in pairwise(numbers)]
        finish(source)
    restart = 1 + falls.index(True)
    assert numbers[restart] < 3
    assert gaps[restart]
    assert source.stats.malformed == 0


def test_a_synchroscan_unit_counts_its_time_in_ps(camera):
    with opened(camera(time_range="3")) as source:
        assert source.calibration is not None
        times = source.calibration.fields["row_times"].values
        assert_allclose(times, LIGHT.row_times, rtol=1e-6)
    server = camera(time_range="2", has_scaling_table=False)
    with opened(server, time_ranges_ps="165,480,1200") as source:
        assert source.calibration is not None
        assert_allclose(np.diff(source.calibration.fields["row_times"].values), 480e-12 / 12)


def test_an_emulated_camera_sees_a_scene():
    light = simulate_light("small")
    address = "sim+remoteex://?seed=4&scene=small&frame_rate=100&frames=4&mcp_gain=5"
    with devices.open(address) as source:
        frames, known, info = take(source, 4), source.calibration, source.info
        finish(source)
    assert info.instrument.startswith("emulated Hamamatsu")
    assert known is not None
    assert Camera.from_record(known.child("camera", "camera")).slit_width_px == 256
    counts, expected = np.sum([frame["counts"] for frame in frames], axis=0), 4 * light.photons
    # Poisson of 4 exposures: the sum over 147 456 pixels to a tenth of a percent, bright pixels to
    # their root.
    assert counts.sum() == pytest.approx(expected.sum(), rel=5e-3)
    bright = light.photons > 100
    noise = (counts - expected)[bright] / np.sqrt(expected[bright])
    assert np.std(noise) == pytest.approx(1, abs=0.1)


# The SPAD512's messages

exposures = st.builds(
    SpadOptions,
    bits=st.sampled_from(BIT_DEPTHS[1:]),
    exposure_us=st.integers(1, 10**9).map(lambda nanoseconds: nanoseconds * 1e-3),
    images=st.integers(1, 1000),
    width=st.sampled_from(IMAGE_WIDTHS_PX),
)


@given(exposures)
def test_requests_come_back(exposure):
    found = SpadOptions.decode(exposure.encode())
    # nine digits travel
    assert found.exposure_us == pytest.approx(exposure.exposure_us, rel=1e-8)
    assert replace(found, exposure_us=exposure.exposure_us) == exposure


def test_requests_as_the_makers_examples_write_them():
    three = SpadOptions(bits=8, exposure_us=2000, images=3)
    for bits, width, line in (
        (8, 128, b"I,8,2,3,0,1,0,1,128"),  # milliseconds
        (1, 512, b"I,1,2000,3,0,1,0,1,512"),  # microseconds
        (4, 64, b"I,4,2000,3,0,1,0,1,64"),  # these as well
        (6, 512, b"I,6,2,3,0,1,0,1,512"),
    ):
        assert replace(three, bits=bits, width=width).encode() == line
    # The vendor's class leaves the width out, and its gated mode has none.
    assert SpadOptions.decode(b"I,8,2,3,0,1,0,1") == three
    scan = {"gate_steps": 10, "gate_step_ps": 36, "gate_width_ns": 5, "gate_offset_ps": 100}
    gated = replace(three, mode="gated", **scan)
    assert gated.encode() == b"G,8,2,3,10,36,0,5,100,0,1,0,1"
    assert SpadOptions.decode(gated.encode()) == gated
    assert gated.frames == 30
    assert SpadOptions(pile_up=True).encode_pile_up() == b"PU,1"


# The SPAD array


@pytest.mark.parametrize(
    "values",
    [
        {"bits": 1, "width": 512, "exposure_us": 5},
        {"bits": 8},
        {"bits": 12, "images": 3},
        {"bits": 8, "pile_up": 1, "width": 4},
    ],
)
def test_array_pictures_come_bit_for_bit(array, values):
    server = array()
    with opened(server, **values) as source:
        frames, info = take(source, 5), source.info.as_dict()
        finish(source)
    exposure = SpadOptions(**{"width": 64, **values})
    for place, frame in enumerate(frames):
        sent = server.draw_frame(*divmod(place, exposure.images), exposure).tobytes()
        assert exposure.codec.encode(frame.reshape(1)) == exposure.codec.pack_frame(place, sent)
    assert info["greeting"] == "SPAD512S emulated server, ready"
    assert info["serial"] == "EMULATED-1"
    assert (info["rows"], info["columns"]) == (512, exposure.width)
    # Up to 200 photons in the millisecond, or one in five microseconds: the picture is Poisson
    # about the light, and not turned.
    counts = np.mean([frame["counts"] for frame in frames], axis=0)
    correlation = np.corrcoef(counts.ravel(), ARRAY_LIGHT[:, : exposure.width].ravel())[0, 1]
    assert correlation > (0.5 if values["bits"] == 1 else 0.95)


def test_single_bits_lie_as_the_other_depths_do(array):
    """The hardware sends them turned by a quarter: one bright corner tells."""
    corner = np.zeros((ROWS, ROWS))
    corner[:100, :50] = 1e9
    with opened(array(light=corner), bits=1, width=512) as source:
        assert_array_equal(take(source, 1)[0]["counts"] > 0, corner > 0)
        finish(source)


def test_pixels_that_spell_the_end_are_pixels():
    """DONE at the end of every piece that arrives: only the length tells where a picture ends."""
    pixels = np.frombuffer(b"DONE" * (512 * 4 // 4), np.uint8)

    def serve(connection):
        connection.send(b"hello")
        for said in (b"system", b"off"):
            connection.read_available()
            connection.send(said)
        while connection.read_available() is not None:
            for start in range(0, pixels.size, 512):
                connection.send(pixels[start : start + 512].tobytes())
            connection.send(b"DONE")

    with LoopbackServer(serve) as server, opened(server, width=4) as source:
        for frame in take(source, 3):
            assert_array_equal(frame["counts"].ravel(), pixels)


def test_a_picture_that_was_cut_is_malformed(array):
    with opened(array(Fault(2, "unplug")), images=2) as source:
        read_gaps(source, 9)
        finish(source)
    assert (source.stats.reconnects, source.stats.malformed) == (1, 1)


@pytest.mark.parametrize(
    ("fault", "said"),
    [
        # with the mark behind the text, in front of it, or behind a part of a picture
        *((Fault(1, "stall", amount), r"he FIFO is full\.") for amount in (1, 2, 3)),
        (Fault(1, "corrupt"), "ended in b'GONE'"),  # an answer of another length
    ],
)
def test_what_the_server_complains_of_is_passed_on(array, fault, said):
    with opened(array(fault)) as source, pytest.raises(DeviceError, match=said):
        take(source, 5)
    assert (source.stats.delivered, source.stats.malformed) == (1, 1)


def test_a_silent_server_counts_as_gone(array):
    with opened(array(Fault(1, "timeout", 20)), timeout_s=0.3, reconnect_s=0.1) as source:
        take(source, 4)
        finish(source)
    assert source.stats.reconnects == 1


def test_a_server_that_calibrates_itself_first_and_frames_nothing(array):
    with opened(array(is_framed=False, must_calibrate=True)) as source:
        assert len(take(source, 2)) == 2
        finish(source)


def test_a_gated_array_is_a_flash_lidar():
    """Scans of a gate become the scene's ranges in one call."""
    gated = "mode=gated&gate_steps=30&gate_step_ps=700&binning=16"
    counted = read_photons(f"sim+spad512://?seed=1&{gated}")
    assert counted.counts.shape == (30, 32, 32)
    assert counted.pulse is not None
    # A pixel shows its light up to the last opening before the light's delay.
    blocks = render_array_delays().reshape(32, 16, 32, 16)
    earliest, latest = blocks.min(axis=(1, 3)), blocks.max(axis=(1, 3))
    bright = render_array_light().reshape(32, 16, 32, 16).mean(axis=(1, 3)) > 0.3
    even = bright & (latest - earliest < 1e-11)  # NaN where a part of the pixel sees nothing
    half = (counted.counts.max(axis=0) + counted.counts.min(axis=0)) / 2
    last = counted.times[29 - np.argmax(counted.counts[::-1] > half, axis=0)]
    step, edge = counted.bin_width, 2e-10
    assert even.sum() > 50
    assert np.all(last[even] - edge <= earliest[even])
    assert np.all(earliest[even] <= last[even] + step + edge)
    assert counted.to_image().bins == 30


def test_a_scan_that_was_cut_is_left_out(array):
    server = array(Fault(0, "unplug"), delays=DELAYS_S)
    address = f"spad512://{HOST}:{server.port}?mode=gated&gate_steps=4&gate_step_ps=1500"
    counted = read_photons(f"{address}&scans=2&binning=16")
    with devices.open(address) as source:
        assert [int(frame["number"]) for frame in take(source, 4)] == [0, 1, 2, 3]
    sums = counted.counts.sum(axis=(1, 2))
    # Open at 5, 6.5 and 8 ns for 5 ns, light at 8: half of it in the third, none in the fourth.
    assert sums[0] == pytest.approx(sums[1], rel=0.01)
    assert sums[2] == pytest.approx(sums[0] / 2, rel=0.1)
    assert sums[3] < sums[0] / 20


def test_what_counts_no_photons_in_time():
    with pytest.raises(InputError, match="mode=gated"):
        read_photons("sim+spad512://?seed=1&width=4")


def test_clients_of_the_vendor_are_answered(array):
    """Commands without an end, eight fields, the information first: as others' clients speak."""
    server = array(is_framed=False, delays=DELAYS_S)
    with TcpLink(HOST, server.port, 5) as link:

        def ask(command):
            link.send(command.encode(), 5)
            return link.read_available(8192, 5).decode().splitlines()

        assert link.read_available(8192, 5).split()[0] == b"SPAD512S"
        assert len(ask("D")) == 9
        assert [float(word) for word in ask("R")[0].split(",")][4:] == [4e7, 100.0]
        assert len(ask("V")[0].split(",")) == 2
        for command in ("V,3.0", "AE,0,1", "CALIB,0", "PU,1", "PU,0"):
            assert ask(command)
        assert ask("F,c0")[0].startswith("ERROR")
        assert ask("Gf,1,18,5,1")[2:] == [
            "The number of gate steps is 1388",
            "The gate offset is 0 ps",
            "The minimum gate step size is 18 ps",
        ]
        for command, pictures in ((b"I,8,1.0,2,0,0,0,1", 2), (b"G,8,1.0,1,3,36,0,5,0,0,1,0,1", 3)):
            link.send(command, 5)
            data = link.read_exactly(pictures * ROWS * ROWS + 4, 1 << 22, 10)
            assert data.endswith(b"DONE")
