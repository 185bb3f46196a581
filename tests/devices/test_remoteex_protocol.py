"""RemoteEx's messages."""

from __future__ import annotations

import hypothesis.strategies as st
import pytest
from hypothesis import given

from devices.remoteex import REFUSAL_REASONS, TERMINATOR, Answer, AnswerCode, Command
from tofclip.errors import DeviceBusyError, DeviceError, InputError, ProtocolError

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
