"""The wire of ZeroMQ 4: literal bytes of RFC 23 and RFC 37, and what breaks their rules."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from daemon.publish.zmtp import GREETING, Message, Parser, Role, ZmtpError, frame, message, ready


def octets(text: str) -> bytes:
    return bytes.fromhex(text)


# RFC 23: signature %xFF 8OCTET %x7F, version, mechanism of 20 octets, as-server, filler of 31.
GREETING_30 = (
    octets("ff 00 00 00 00 00 00 00 01 7f 03 00 4e 55 4c 4c")
    + octets("00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00")
    + octets("00" * 32)
)
GREETING_31 = GREETING_30[:11] + b"\x01" + GREETING_30[12:]
GREETING_CURVE = GREETING_31[:12] + b"CURVE" + GREETING_31[17:]
# command-size, %d5 "READY", then %d11 "Socket-Type" %d3 "SUB".
READY_SUB = octets(
    "04 19 05 52 45 41 44 59 0b 53 6f 63 6b 65 74 2d 54 79 70 65 00 00 00 03 53 55 42"
)
# "REQ" with an empty Identity, as libzmq says it.
READY_REQ = octets(
    "04 26 05 52 45 41 44 59 0b 53 6f 63 6b 65 74 2d 54 79 70 65 00 00 00 03 52 45 51"
    "08 49 64 65 6e 74 69 74 79 00 00 00 00"
)
READY_XPUB = octets(
    "04 1a 05 52 45 41 44 59 0b 53 6f 63 6b 65 74 2d 54 79 70 65 00 00 00 04 58 50 55 42"
)
SUBSCRIBE_30 = octets("00 02 01 76")
CANCEL_30 = octets("00 02 00 76")
SUBSCRIBE_31 = octets("04 0b 09 53 55 42 53 43 52 49 42 45 76")
CANCEL_31 = octets("04 08 06 43 41 4e 43 45 4c 76")
# RFC 37: ping = command-size %d4 "PING" ping-ttl ping-context.
PING = octets("04 0a 04 50 49 4e 47 00 1e 61 62 63")
PONG = octets("04 08 04 50 4f 4e 47 61 62 63")
LONG_FRAME = octets("02 00 00 00 00 00 00 00 01 78")


def taken(parser: Parser, data: bytes, step: int = 1 << 20) -> tuple[list[Message], bytes]:
    messages: list[Message] = []
    answers = b""
    for at in range(0, len(data), step):
        answers += parser.take(data[at : at + step], messages)
    return messages, answers


@pytest.mark.parametrize("step", [1, 7, 64, 1000])
@pytest.mark.parametrize("greeting", [GREETING_30, GREETING_31])
def test_a_subscriber_is_understood_however_its_bytes_are_cut(greeting: bytes, step: int) -> None:
    parser = Parser(Role.XPUB)
    said = greeting + READY_SUB + SUBSCRIBE_30 + CANCEL_30 + SUBSCRIBE_31 + CANCEL_31 + PING
    messages, answers = taken(parser, said, step)
    assert messages == [[b"\x01v"], [b"\x00v"], [b"\x01v"], [b"\x00v"]]
    assert answers == READY_XPUB + PONG
    assert parser.is_ready


def test_a_question_of_two_frames_is_understood() -> None:
    parser = Parser(Role.ROUTER)
    said = GREETING_31 + READY_REQ + octets("01 00 00 05 6a 75 64 67 65") + LONG_FRAME
    assert taken(parser, said)[0] == [[b"", b"judge"], [b"x"]]


def test_what_is_sent_is_as_the_standard_has_it() -> None:
    assert GREETING[:10] == octets("ff 00 00 00 00 00 00 00 00 7f")
    assert GREETING[10:] == GREETING_31[10:]
    assert len(GREETING) == 64
    assert ready(Role.XPUB) == READY_XPUB
    assert message((b"v", b"ab")) == octets("01 01 76 00 02 61 62")
    assert frame(b"x" * 255) == octets("00 ff") + b"x" * 255
    assert frame(b"x" * 256) == octets("02 00 00 00 00 00 00 01 00") + b"x" * 256


WELL = GREETING_31 + READY_SUB
BROKEN = {
    "http": b"GET / HTTP/1.1\r\n\r\n",
    "zeros": bytes(64),
    "no signature": octets("ff 00 00 00 00 00 00 00 01 00"),
    "ZeroMQ 3": octets("ff 00 00 00 00 00 00 00 01 7f 01 02 00 00"),
    "keys": GREETING_CURVE,
    "a message instead of READY": GREETING_31 + SUBSCRIBE_30,
    "another command instead of READY": GREETING_31 + PING,
    "no socket type": GREETING_31 + octets("04 06 05 52 45 41 44 59"),
    "a type that does not subscribe": GREETING_31 + READY_REQ,
    "half a property": GREETING_31 + octets("04 0a 05 52 45 41 44 59 0b 53 6f 63"),
    "a huge READY": GREETING_31 + octets("06 00 00 00 00 00 00 02 01"),
    "unknown flags": WELL + octets("08 00"),
    "a command with more": WELL + octets("05 00"),
    "a frame of 129 bytes": WELL + octets("00 81"),
    "a frame of 2^63 bytes": WELL + octets("02 80 00 00 00 00 00 00 00"),
    "a message without an end": WELL + octets("01 00") * 4,
}


@pytest.mark.parametrize("name", BROKEN)
def test_who_breaks_a_rule_is_found_out_before_the_frame_is_whole(name: str) -> None:
    with pytest.raises(ZmtpError):
        taken(Parser(Role.XPUB), BROKEN[name])


@given(st.binary(max_size=600), st.sampled_from([b"", GREETING_31, WELL]), st.integers(1, 50))
def test_noise_is_parsed_or_refused_and_little_is_held(
    noise: bytes, before: bytes, step: int
) -> None:
    parser = Parser(Role.XPUB)
    try:
        messages, _ = taken(parser, before + noise, step)
    except ZmtpError:
        return
    for each in messages:
        assert len(each) <= 4
        assert all(len(part) <= 128 for part in each)


def test_an_empty_command_is_nothing() -> None:
    assert taken(Parser(Role.XPUB), WELL + octets("04 00"))[0] == []
