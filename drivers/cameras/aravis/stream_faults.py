"""Faults of a head's stream, from the growth of its counters: events and their sentences."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator


def stream_faults(
    head: str, before: Counter[str], now: Counter[str], *, others: str, byte_order: str
) -> Iterator[tuple[str, str]]:
    """Faults whose counters have grown.

    Args:
        head: name of the head.
        before: counters at the last call.
        now: counters now.
        others: what is done with the datagrams of other senders, as the end of a clause.
        byte_order: order of the bytes of a pixel as it is configured, "little" or "big".

    Yields:
        Name of the event, and what happened with its remedy.
    """
    if now["kernel_drops"] > before["kernel_drops"]:
        yield (
            "kernel-drops",
            f"The kernel dropped {now['kernel_drops']} packets of the head {head}, since "
            "the buffer of their socket was full. Raise net.core.rmem_max and "
            "socket_buffer_bytes, and end other programs.",
        )
    if now["other_senders"] > before["other_senders"]:
        yield (
            "other-sender",
            f"{now['other_senders']} datagrams of other senders arrived at the ports of head "
            f"{head} and were dropped, {others}. Disconnect the other sender, or connect the heads "
            "to a separate network.",
        )
    if now["chunks_unreadable"] > before["chunks_unreadable"]:
        yield (
            "chunks-unreadable",
            f"The head {head} sent frames whose chunk data cannot be read. They are used with the "
            "time of their leader packet and without an exposure counter. Update the head's "
            "firmware, or set chunks = false.",
        )
    if now["frames_swapped"] > before["frames_swapped"]:
        other = "big" if byte_order == "little" else "little"
        yield (
            "byte-order",
            f"The head {head} sends the bytes of its pixels in the other order: byte_order is "
            f'"{byte_order}". Its images cannot be used. Set byte_order = "{other}".',
        )


def restarted_sentence(head: str) -> str:
    """What it means that the numbers of frames went backwards, and the remedy.

    Args:
        head: name of the head.

    Returns:
        Sentences for the operator.
    """
    return (
        f"The head {head} numbered its frames out of order, so they were dropped as old. The "
        "stream was restarted; one exposure may have no frame. Check the head's power supply and "
        "firmware."
    )
