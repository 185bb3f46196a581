"""RemoteEx: messages, and the driver against an emulated camera that can fail."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Callable, Iterator

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given
from instruments import finish, read_gaps, take

import devices
from devices.emulation.harness import HOST, Connection, Fault, LoopbackServer
from devices.emulation.remoteex import EmulatedStreakCamera
from devices.emulation.scenes import (
    EmulatedLight,
    simulate_demonstration_light,
    simulate_line_light,
)
from devices.remoteex import (
    REFUSAL_REASONS,
    TERMINATOR,
    Answer,
    AnswerCode,
    Command,
    RemoteExClient,
    StreakOptions,
)
from devices.source import Source
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

names = st.from_regex(r"[A-Za-z][A-Za-z0-9_]{0,20}", fullmatch=True)
arguments = st.lists(
    st.text(
        st.characters(codec="latin-1", exclude_characters=",()", exclude_categories=["Cc"]),
        max_size=9,
    ),
    max_size=5,
).filter(lambda words: words != [""])


@given(names, arguments)
def test_commands_come_back(name: str, words: list[str]) -> None:
    command = Command(name, tuple(words))
    assert Command.decode(command.encode().removesuffix(TERMINATOR)) == command


def test_text_is_latin_1() -> None:
    assert Answer.decode(b"0,DevParamGet,10 \xb5s").arguments == ("10 µs",)
    assert Command("DevParamSet", ("TD", "Time Range", "10 µs")).encode().endswith(b"10 \xb5s)\r")
    with pytest.raises(InputError):
        Command("DevParamSet", ("Ω",)).encode()


@given(st.sampled_from(AnswerCode), names, arguments)
def test_answers_come_back(code: AnswerCode, name: str, words: list[str]) -> None:
    answer = Answer(code, name, tuple(words))
    assert Answer.decode(answer.encode().removesuffix(TERMINATOR)) == answer


def test_messages_as_the_handbook_writes_them() -> None:
    assert (
        Command("DevParamSet", ("TD", "MCP Gain", "0")).encode() == b"DevParamSet(TD,MCP Gain,0)\r"
    )
    assert Command("AcqStop").encode() == b"AcqStop()\r"
    assert Answer.decode(b"0,ImgRingBufferGet,672,508,2,0,14,1234") == Answer(
        AnswerCode.DONE, "ImgRingBufferGet", ("672", "508", "2", "0", "14", "1234")
    )


@pytest.mark.parametrize("words", [("a,b",), ("(",), ("a\r",), ("",)])
def test_what_the_protocol_cannot_carry(words: tuple[str, ...]) -> None:
    with pytest.raises(InputError):
        Command("AcqStart", words).encode()
    with pytest.raises(InputError):
        Answer(AnswerCode.DONE, "Acq Start").encode()


@pytest.mark.parametrize(
    "message",
    [b"", b"0", b"0,", b"11,Name", b"x,Name", b"-1,Name", b"\xff\xfe", b"\xb2,Name", b"0,A\nB"],
)
def test_answers_that_are_none(message: bytes) -> None:
    with pytest.raises(ProtocolError):
        Answer.decode(message)


@pytest.mark.parametrize("code", REFUSAL_REASONS)
def test_every_refusal_is_explained(code: AnswerCode) -> None:
    with pytest.raises(DeviceError, match=r"refused AcqStart\(Live\): .*\(why\)") as caught:
        Answer(code, "AcqStart", ("why",)).require_done(Command("AcqStart", ("Live",)))
    assert isinstance(caught.value, DeviceBusyError) == (code is AnswerCode.NOT_NOW)


LIGHT = EmulatedLight(
    np.random.default_rng(1).uniform(0, 50, (12, 20)),
    np.cumsum(np.linspace(18e-12, 20e-12, 12)),
    full_scale=60,
    seed=3,
)

Make = Callable[..., EmulatedStreakCamera]


@pytest.fixture
def camera() -> Iterator[Make]:
    """Make emulated cameras that are switched off in the end."""
    made = []

    def make(
        *faults: Fault, rate: float = 100.0, frames: int = 1000, **found: object
    ) -> EmulatedStreakCamera:
        kind = type("Camera", (EmulatedStreakCamera,), found)
        made.append(kind(LIGHT, rate, frames, faults))
        return made[-1]

    yield make
    for server in made:
        server.close()


def opened(server: EmulatedStreakCamera, **values: object) -> Source:
    port, data_port = server.ports
    query = "".join(f"&{name}={value}" for name, value in values.items())
    return devices.open(f"remoteex://{HOST}:{port}?data_port={data_port}{query}")


def test_pictures_come_in_order_and_bit_for_bit(camera: Make) -> None:
    server = camera()
    with opened(server, mcp_gain=30) as source:
        assert server.gain == "30"
        assert source.is_live
        frames = take(source, 12)
        finish(source)
    numbers = [int(frame["number"]) for frame in frames]
    assert numbers == list(range(numbers[0], numbers[0] + 12))
    for frame in frames:
        np.testing.assert_array_equal(frame["counts"], LIGHT.draw_frame(int(frame["number"])))
    assert server.gain == "0"


def test_what_is_known_of_the_camera(camera: Make) -> None:
    with opened(camera()) as source:
        info, calibration = source.info.as_dict(), source.calibration
    assert info["time_range"] == "20 ns"
    assert (info["mode"], info["rows"], info["columns"]) == ("Operate", 12, 20)
    assert calibration is not None
    # float32 numbers in ns, as the camera sends them.
    np.testing.assert_allclose(
        calibration.array("row_times", float, 1, "s"), LIGHT.row_times, rtol=1e-7
    )


def test_the_gain_goes_down_even_if_the_stream_has_failed(camera: Make) -> None:
    server = camera(Fault(3, "corrupt"))
    with opened(server, mcp_gain=20) as source, pytest.raises(ProtocolError):
        take(source, 100)
    assert server.gain == "0"
    assert source.stats.is_balanced


def test_pictures_that_fell_out_of_the_ring_are_accounted_for(camera: Make) -> None:
    with opened(camera(Fault(4, "lost", 7))) as source:
        gaps = read_gaps(source, 20)
        finish(source)
    assert source.stats.lost_device >= 7
    assert any(gaps)


def test_a_late_answer_is_waited_for_and_not_asked_for_again(camera: Make) -> None:
    """An answer later than the time to wait: the picture comes all the same, and no other is taken
    for it.
    """
    with opened(camera(Fault(3, "timeout", 5), Fault(6, "short", 5)), timeout_s=0.2) as source:
        frames = take(source, 15)
        finish(source)
    assert source.stats.timeouts >= 2
    for frame in frames:
        np.testing.assert_array_equal(frame["counts"], LIGHT.draw_frame(int(frame["number"])))


def test_after_an_unplugged_cable_the_stream_goes_on(camera: Make) -> None:
    with opened(camera(Fault(5, "unplug"))) as source:
        gaps = read_gaps(source, 20)
        finish(source)
    assert source.stats.reconnects == 1
    assert gaps.count(True) == 1


def test_a_camera_that_stays_away(camera: Make) -> None:
    server = camera()
    with opened(server, reconnect_s=0.3) as source:
        take(source, 3)
        server.close()
        with pytest.raises(DeviceDisconnectedError, match=r"no answer came for 0\.3 s"):
            take(source, 100)
    assert source.stats.is_balanced


def test_a_picture_larger_than_any_is_refused_before_memory_is_take(camera: Make) -> None:
    with (
        opened(camera(Fault(2, "overflow"))) as source,
        pytest.raises(ProtocolError, match="at most"),
    ):
        take(source, 100)


def test_nobody_there() -> None:
    with pytest.raises(DeviceNotFoundError, match="is its program running"):
        devices.open(f"remoteex://{HOST}:1")


@pytest.mark.parametrize(
    "query",
    [
        "buffers=0",
        "mcp_gain=64",
        "timeout_s=0",
        "speed=1",
        "policy=x",
        "buffer_mib=0",
        "mcp_gain=x",
    ],
)
def test_impossible_values_are_refused(query: str) -> None:
    with pytest.raises(InputError):
        devices.open(f"remoteex://{HOST}:1?{query}")


def test_impossible_emulations_are_refused() -> None:
    with pytest.raises(InputError, match="frame rate"):
        EmulatedStreakCamera(LIGHT, 0)
    with pytest.raises(InputError, match="faults are"):
        EmulatedStreakCamera(LIGHT, 1, 5, [Fault(0, "stall")])
    with pytest.raises(InputError, match="reconnect_s must be at least 0 and at most 600, got -1"):
        StreakOptions(reconnect_s=-1)


def scripted(answers: dict[bytes, bytes]) -> Callable[[Connection], None]:
    """Serve from a script: every request has its answer, an unknown one has none."""

    def serve(connection: Connection) -> None:
        connection.send(answers.get(b"greeting", b"RemoteEx Ready\r"))
        while (request := connection.read_request(TERMINATOR)) is not None:
            connection.send(answers.get(request, b""))

    return serve


def data_server(data: bytes) -> LoopbackServer:
    def serve(connection: Connection) -> None:
        connection.send(b"RemoteEx Data Ready\r")
        time.sleep(0.1)  # what comes before the question is thrown away
        connection.send(data)
        connection.read_request(TERMINATOR)

    return LoopbackServer(serve)


PICTURE = b"ImgRingBufferGet(Data,0)"


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
def test_answers_about_pictures_that_make_no_sense(answer: bytes, problem: str) -> None:
    with LoopbackServer(scripted({PICTURE: answer})) as commands, data_server(b"pixels") as data:
        link = RemoteExClient(HOST, commands.port, data.port, 2)
        with pytest.raises(ProtocolError, match=problem):
            link.read_frame(0)
        link.close()


def test_messages_are_kept_while_an_answer_is_awaited() -> None:
    answers = {b"AcqStop()": b"4,LiveMonitor,RingBuffer,1\r0,AcqStop\r", b"Other()": b"0,Unasked\r"}
    with LoopbackServer(scripted(answers)) as commands, data_server(b"") as data:
        link = RemoteExClient(HOST, commands.port, data.port, 0.3)
        assert link.ask("AcqStop") == ()
        assert link.read_message(1).arguments == ("RingBuffer", "1")
        with pytest.raises(DeviceTimeoutError):
            link.read_message(0.05)
        with pytest.raises(
            DeviceTimeoutError, match=r"AcqStart\(\) for 0\.3 s; it is not asked again"
        ):
            link.ask("AcqStart")
        with pytest.raises(
            DeviceTimeoutError
        ):  # still owed: nothing else is sent before it has come
            link.ask("AcqStop")
        link.close()


@pytest.mark.parametrize("greeting", [b"SSH-2.0\r", b"RemoteEx Data Ready\r"])
def test_another_server_is_recognised(greeting: bytes) -> None:
    with (
        LoopbackServer(scripted({b"greeting": greeting})) as commands,
        pytest.raises(ProtocolError, match="expected 'RemoteEx Ready'"),
    ):
        RemoteExClient(HOST, commands.port, commands.port, 2)


def test_another_data_server_is_recognised() -> None:
    with LoopbackServer(scripted({})) as commands, LoopbackServer(scripted({})) as data:
        with pytest.raises(ProtocolError, match="expected 'RemoteEx Data Ready'"):
            RemoteExClient(HOST, commands.port, data.port, 2)
        data.close()
        with pytest.raises(DeviceNotFoundError):
            RemoteExClient(HOST, commands.port, data.port, 2)


def test_an_emulated_camera_sees_a_scene() -> None:
    light = simulate_line_light()
    with devices.open(
        "sim+remoteex://?seed=4&scene=small&frame_rate=100&frames=4&mcp_gain=5"
    ) as source:
        frames, known, info = take(source, 4), source.calibration, source.info
        finish(source)
    assert info.instrument.startswith("emulated Hamamatsu")
    assert known is not None
    assert Camera.from_record(known.child("camera", "camera")).slit_width_px == 256
    counts = np.sum([frame["counts"] for frame in frames], axis=0)
    # Poisson of 4 exposures: the sum over 147 456 pixels to a tenth of a percent, bright pixels to
    # their root.
    assert counts.sum() == pytest.approx(4 * light.photons.sum(), rel=5e-3)
    bright = light.photons > 100
    assert np.std(
        (counts - 4 * light.photons)[bright] / np.sqrt(4 * light.photons[bright])
    ) == pytest.approx(1, abs=0.1)


@pytest.mark.parametrize(
    "query", ["seed=-1", "scene=none", "frame_rate=0", "faults=x", "data_port=3", "speed=1"]
)
def test_emulations_that_cannot_be(query: str) -> None:
    with pytest.raises(InputError):
        devices.open(f"sim+remoteex://?scene=small&{query}")


def test_the_demonstrations_light_comes_with_what_focus_pictures_tell() -> None:
    light = simulate_demonstration_light()
    assert light.photons.shape == (576, 1344)
    assert light.photons.max() == pytest.approx(2002, rel=1e-6)  # peak and background
    assert light.camera.sweep is None
    assert light.camera.gains.tolist() == [1.0] * 7


def test_servers_are_for_this_computer_only() -> None:
    with LoopbackServer(lambda connection: None) as server:
        assert server.server_address[0] == "127.0.0.1"
        others = {
            str(entry[4][0])
            for entry in socket.getaddrinfo(socket.gethostname(), None, socket.AF_INET)
        }
        for address in others - {"127.0.0.1"}:
            with pytest.raises(OSError, match="refused"):
                socket.create_connection((address, server.port), 1)


def test_no_thread_is_left_behind(camera: Make) -> None:
    before = threading.active_count()
    server = camera()
    with opened(server) as source:
        take(source, 3)
    server.close()
    deadline = time.monotonic() + 5
    while threading.active_count() > before and time.monotonic() < deadline:
        time.sleep(0.05)
    assert threading.active_count() == before


def test_hpd_ta_is_started_where_it_is_not_up(camera: Make) -> None:
    server = camera(is_application_up=False)
    with opened(server, mcp_gain=9) as source:
        assert len(take(source, 3)) == 3
        assert server.gain == "9"


def test_live_mode_of_an_operator_is_joined_and_goes_on(camera: Make) -> None:
    server = camera(is_live=True, rate=200.0)
    server.gain = "13"
    time.sleep(0.05)
    with opened(server, mcp_gain=20) as source:
        frames = take(source, 5)
        assert server.gain == "20"
    assert frames[0]["number"] > 0
    assert server.is_running
    assert server.gain == "13"


def test_a_busy_camera_is_waited_for_or_stopped(camera: Make) -> None:
    for busy_for in (3, 10**9):
        server = camera(busy_for=busy_for)
        with opened(server, timeout_s=0.5) as source:
            assert len(take(source, 3)) == 3


def test_numbers_that_restart_are_followed(camera: Make) -> None:
    server = camera(restart_at=20)
    numbers: list[int] = []
    gaps = []
    with opened(server) as source:
        while len(numbers) < 40:
            batch = source.read(5)
            assert batch is not None
            numbers += batch.records["number"].tolist()
            gaps += [batch.after_gap] * len(batch)
        source.stop()
        while source.read() is not None:
            pass
    restart = numbers.index(max(numbers[:25])) + 1
    assert numbers[restart] < 3
    assert gaps[restart]
    assert source.stats.malformed == 0
    assert source.stats.is_balanced


def test_a_synchroscan_unit_counts_its_time_in_ps(camera: Make) -> None:
    with opened(camera(time_range="3")) as source:
        assert source.calibration is not None
        times = source.calibration.fields["row_times"].values
        np.testing.assert_allclose(times, LIGHT.row_times, rtol=1e-6)
    server = camera(time_range="2", has_scaling_table=False)
    with opened(server, time_ranges_ps="165,480,1200") as source:
        assert source.calibration is not None
        times = source.calibration.fields["row_times"].values
        np.testing.assert_allclose(np.diff(times), 40e-12)


def test_the_time_range_can_be_set(camera: Make) -> None:
    server = camera()
    with opened(server, time_range="100 ns") as source:
        assert source.info.details["time_range"] == "100 ns"


def test_stray_bytes_on_the_data_port_are_thrown_away(camera: Make) -> None:
    server = camera(stray_bytes=1000)
    with opened(server) as source:
        for frame in take(source, 3):
            np.testing.assert_array_equal(frame["counts"], LIGHT.draw_frame(int(frame["number"])))


def test_an_error_of_several_lines_does_not_shift_the_answers() -> None:
    answers = {
        b"AcqStart(Live)": b"7,AcqStart,raw\rdata \xb5\r\nmore\r",
        b"AcqStatus()": b"5,HAcq: odd\rtext\r0,acqstatus,idle\r",
    }
    with LoopbackServer(scripted(answers)) as commands, data_server(b"") as data:
        link = RemoteExClient(HOST, commands.port, data.port, 1)
        assert not link.is_done("AcqStart", "Live")
        assert link.ask("AcqStatus") == ("idle",)
        link.close()
