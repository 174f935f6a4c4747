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
    return MessageFramer(
        b"$!", size_of, lambda message_bytes: sum(message_bytes[:-1]) & 0xFF == message_bytes[-1]
    )


def counted(framer_under_test: MessageFramer) -> tuple[int, int, int, int]:
    return (
        framer_under_test.frames,
        framer_under_test.bad_frames,
        framer_under_test.bad_bytes,
        framer_under_test.pending,
    )


ONE, TWO = message(b"abc"), message(b"", b"!")


def test_messages_between_noise_are_found_and_the_noise_is_counted() -> None:
    framer_under_test = framer()
    assert framer_under_test.feed(b"xy" + ONE + b"z" + TWO + b"w") == [ONE, TWO]
    assert counted(framer_under_test) == (2, 0, 4, 0)


@pytest.mark.parametrize("piece", [1, 2, 3, 5])
def test_the_cuts_of_a_stream_change_nothing(piece: int) -> None:
    framer_under_test = framer()
    stream = b"xy" + ONE + b"z" + TWO + b"w" + ONE[:4]
    found = [
        m
        for at in range(0, len(stream), piece)
        for m in framer_under_test.feed(stream[at : at + piece])
    ]
    assert found == [ONE, TWO]
    assert counted(framer_under_test) == (2, 0, 4, 4)
    framer_under_test.reset()
    assert counted(framer_under_test) == (2, 0, 8, 0)
    assert framer_under_test.feed(ONE[4:]) == []
    assert counted(framer_under_test) == (2, 0, 10, 0)


def test_a_damaged_message_costs_itself_only() -> None:
    framer_under_test = framer()
    damaged = bytearray(ONE)
    damaged[3] ^= 1
    assert framer_under_test.feed(bytes(damaged) + TWO) == [TWO]
    assert counted(framer_under_test) == (1, 1, 6, 0)


def test_a_size_that_cannot_be_costs_one_byte_and_is_no_frame() -> None:
    framer_under_test = framer()
    assert framer_under_test.feed(b"$\x02" + TWO) == [TWO]
    assert counted(framer_under_test) == (1, 0, 2, 0)


def test_a_start_that_waits_gives_way_to_a_complete_message_inside_it() -> None:
    framer_under_test = framer()
    assert framer_under_test.feed(b"$\x14" + b"ab" + ONE) == [ONE]
    assert counted(framer_under_test) == (1, 1, 4, 0)


def test_a_start_that_waits_is_retained_where_what_is_inside_is_incomplete_or_damaged() -> None:
    framer_under_test = framer()
    waiting = b"$\x14" + b"a" + ONE[:-1]
    assert framer_under_test.feed(waiting) == []
    assert counted(framer_under_test) == (0, 0, 0, 8)
    framer_under_test = framer()
    waiting = b"$\x14" + b"a" + ONE[:-1] + bytes([ONE[-1] ^ 1])
    assert framer_under_test.feed(waiting) == []
    assert counted(framer_under_test) == (0, 0, 0, 9)


def test_a_complete_message_that_holds_another_is_not_one() -> None:
    framer_under_test = framer()
    assert framer_under_test.feed(message(b"a" + TWO + b"b")) == [TWO]
    assert counted(framer_under_test) == (1, 1, 5, 0)
    framer_under_test = framer()
    inside_to_the_end = b"$\x07a" + b"!\x04q"
    inside_to_the_end += bytes([sum(b"!\x04q") & 0xFF])
    assert framer_under_test.feed(inside_to_the_end)[-1] == inside_to_the_end[3:]


def test_a_message_that_reaches_beyond_its_outer_one_is_not_inside_it() -> None:
    framer_under_test = framer()
    outer = message(b"ab!\x09c")
    assert framer_under_test.feed(outer) == [outer]
    assert counted(framer_under_test) == (1, 0, 0, 0)


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


def test_a_start_whose_size_is_not_known_yet_gives_way_to_a_whole_message_inside() -> None:
    # `!` stands for a message whose size follows from a byte that is 9 bytes away.
    def late_size_of(buffer: bytes, at: int) -> int | None:
        if buffer[at : at + 1] == b"!":
            return None if len(buffer) < at + 10 else 10
        return size_of(buffer, at)

    framer_under_test = MessageFramer(b"$!", late_size_of, lambda m: sum(m[:-1]) & 0xFF == m[-1])
    assert framer_under_test.feed(b"!x") == []
    assert framer_under_test.feed(ONE) == [ONE]
    assert counted(framer_under_test) == (1, 1, 2, 0)
