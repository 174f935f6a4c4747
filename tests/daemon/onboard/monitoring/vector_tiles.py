"""A vector tile from the specification's wire format: water in the lower right, a road, a place."""

from __future__ import annotations


def _varint(value: int) -> bytes:
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*out, value])


def _field(number: int, value: bytes | int) -> bytes:
    if isinstance(value, int):
        return _varint(number << 3) + _varint(value)
    return _varint(number << 3 | 2) + _varint(len(value)) + value


def _geometry(points: list[tuple[int, int]], *, kind: int) -> bytes:
    """Commands with zigzag-coded steps: points (1), a line (2) or a closed ring (3)."""
    numbers, at = [], (0, 0)
    for index, (x, y) in enumerate(points):
        if index == 0:
            numbers.append(1 | 1 << 3)
        elif index == 1:
            numbers.append(2 | (len(points) - 1) << 3)
        numbers += [(d << 1) ^ (d >> 31) for d in (x - at[0], y - at[1])]
        at = x, y
    if kind == 3:
        numbers.append(7 | 1 << 3)
    return b"".join(_varint(number & 0xFFFFFFFF) for number in numbers)


def _layer(title: str, form: int, points: list[tuple[int, int]], **about: str) -> bytes:
    tags = b"".join(_varint(k) + _varint(k) for k in range(len(about)))
    feature = _field(2, tags) + _field(3, form) + _field(4, _geometry(points, kind=form))
    body = _field(15, 2) + _field(1, title.encode()) + _field(2, feature)
    body += b"".join(_field(3, key.encode()) for key in about)
    body += b"".join(_field(4, _field(1, value.encode())) for value in about.values())
    return _field(3, body + _field(5, 4096))


def vector_tile() -> bytes:
    """The bytes of the tile, extent 4096."""
    water = [(2500, 2500), (4096, 2500), (4096, 4096), (2500, 4096)]
    road = [(-50, 1000), (2000, 1200), (4150, 900)]
    return b"".join(
        (
            _layer("water", 3, water, kind="lake"),
            _layer("transportation", 2, road, **{"class": "primary"}),
            _layer("place", 1, [(1000, 500)], name="Hamlet"),
        )
    )


def labelled_tile(ground: str) -> bytes:
    """A place in the middle of a tile of one ground, with two roads below its name."""
    whole = [(0, 0), (4096, 0), (4096, 4096), (0, 4096)]
    roads = [[(0, 2048 + d), (4096, 2048 + d)] for d in (-100, 20)]
    return b"".join(
        (
            _layer(ground, 3, whole, kind="all"),
            *(_layer("roads", 2, road, **{"class": "primary"}) for road in roads),
            _layer("place", 1, [(2048, 2048)], name="Hamlet HILL"),
        )
    )
