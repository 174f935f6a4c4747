"""Whole messages out of bytes: what is found, what is counted as bad, and what still waits.

The protocol of these tests: `$` or `!`, the size of the whole message, content, and a sum.
"""

from __future__ import annotations

import pytest

from drivers.receivers.message_framer import MessageFramer, line_size


def message(content: bytes, start: bytes = b"$") -> bytes:
    head = start + bytes([len(content) + 3]) + content
    return head + bytes([sum(head) & 0xFF])


def size_of(buffer: bytes, at: int) -> int | None:
    if at + 1 >= len(buffer):
        return None
    return buffer[at + 1] if 3 <= buffer[at + 1] <= 32 else 0


def framer() -> MessageFramer:
    return MessageFramer(b"$!", size_of, lambda whole: sum(whole[:-1]) & 0xFF == whole[-1])


def counted(made: MessageFramer) -> tuple[int, int, int, int]:
    return made.frames, made.bad_frames, made.bad_bytes, made.pending


ONE, TWO = message(b"abc"), message(b"", b"!")


def test_messages_between_noise_are_found_and_the_noise_is_counted() -> None:
    made = framer()
    assert made.feed(b"xy" + ONE + b"z" + TWO + b"w") == [ONE, TWO]
    assert counted(made) == (2, 0, 4, 0)


@pytest.mark.parametrize("piece", [1, 2, 3, 5])
def test_the_cuts_of_a_stream_change_nothing(piece: int) -> None:
    made = framer()
    stream = b"xy" + ONE + b"z" + TWO + b"w" + ONE[:4]
    found = [m for at in range(0, len(stream), piece) for m in made.feed(stream[at : at + piece])]
    assert found == [ONE, TWO]
    assert counted(made) == (2, 0, 4, 4)
    made.reset()
    assert counted(made) == (2, 0, 8, 0)
    assert made.feed(ONE[4:]) == []
    assert counted(made) == (2, 0, 10, 0)


def test_a_damaged_message_costs_itself_only() -> None:
    made = framer()
    damaged = bytearray(ONE)
    damaged[3] ^= 1
    assert made.feed(bytes(damaged) + TWO) == [TWO]
    assert counted(made) == (1, 1, 6, 0)


def test_a_size_that_cannot_be_costs_one_byte_and_is_no_frame() -> None:
    made = framer()
    assert made.feed(b"$\x02" + TWO) == [TWO]
    assert counted(made) == (1, 0, 2, 0)


def test_a_start_that_waits_gives_way_to_a_whole_message_inside_it() -> None:
    made = framer()
    assert made.feed(b"$\x14" + b"ab" + ONE) == [ONE]
    assert counted(made) == (1, 1, 4, 0)


def test_a_start_that_waits_is_kept_where_what_is_inside_is_not_whole_or_damaged() -> None:
    made = framer()
    waiting = b"$\x14" + b"a" + ONE[:-1]
    assert made.feed(waiting) == []
    assert counted(made) == (0, 0, 0, 8)
    made = framer()
    waiting = b"$\x14" + b"a" + ONE[:-1] + bytes([ONE[-1] ^ 1])
    assert made.feed(waiting) == []
    assert counted(made) == (0, 0, 0, 9)


def test_a_whole_message_that_holds_another_is_not_one() -> None:
    made = framer()
    assert made.feed(message(b"a" + TWO + b"b")) == [TWO]
    assert counted(made) == (1, 1, 5, 0)
    made = framer()
    inside_to_the_end = b"$\x07a" + b"!\x04q"
    inside_to_the_end += bytes([sum(b"!\x04q") & 0xFF])
    assert made.feed(inside_to_the_end)[-1] == inside_to_the_end[3:]


def test_a_message_that_reaches_beyond_its_outer_one_is_not_inside_it() -> None:
    made = framer()
    outer = message(b"ab!\x09c")
    assert made.feed(outer) == [outer]
    assert counted(made) == (1, 0, 0, 0)


@pytest.mark.parametrize(
    ("line", "limit", "size"),
    [
        (b"$AB\n", 9, 4),
        (b"$AB\r\n", 9, 5),
        (b"$AB\r\nrest", 9, 5),
        (b"$AB", 9, None),
        (b"$AB\r", 9, None),
        (b"$AB\rx", 9, 0),
        (b"$A#B\n", 9, 0),
        (b"$A\x80\n", 9, 0),
        (b"AB\n", 9, 0),
        (b"$ABC\n", 5, 5),
        (b"$ABCD\n", 5, 0),
        (b"$ABC", 5, None),
        (b"$ABCD", 5, 0),
        (b"!\n", 5, 2),
    ],
)
def test_a_line_ends_with_a_line_feed_within_its_limit(
    line: bytes, limit: int, size: int | None
) -> None:
    assert line_size(line, 0, limit) == size
    assert line_size(b"xx" + line, 2, limit) == size
