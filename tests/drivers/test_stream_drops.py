"""Datagrams that the kernel drops at the socket of a stream are counted."""

from __future__ import annotations

import socket

from drivers.cameras.aravis.packet_filter import StreamSocketFilter


def test_a_full_buffer_of_the_stream_is_counted_by_the_kernel() -> None:
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stream,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as head,
    ):
        stream.bind(("127.0.0.1", 0))
        head.bind(("127.0.0.1", 0))
        port, source_port = stream.getsockname()[1], head.getsockname()[1]
        senders = StreamSocketFilter(port, "127.0.0.1", source_port, lambda: None)
        try:
            senders.set_receive_buffer(4096)
            assert senders.kernel_drops() == 0
            for _ in range(100):
                head.sendto(bytes(1400), ("127.0.0.1", port))
            dropped = senders.kernel_drops()
            stream.setblocking(False)
            received = 0
            while True:
                try:
                    stream.recv(2048)
                except BlockingIOError:
                    break
                received += 1
        finally:
            senders.close()
    assert dropped > 0
    assert received + dropped == 100
