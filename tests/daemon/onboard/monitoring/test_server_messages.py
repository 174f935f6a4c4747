"""Codes and parameters of the sentences of the service: they agree with the English catalog."""

from __future__ import annotations

import json
import re

import pytest

from daemon.onboard.monitoring.server_messages import (
    CATALOG,
    NUMBERS,
    SENTENCE_MAX,
    english,
    message_of,
    with_messages,
)
from tests.daemon.onboard.monitoring.sentence_literals import codes_of, texts_of

SENTENCES = (
    "Head SU11 sent no image; 9% of pan has no valid pixels, which coverage counts as a gap. "
    "Check power and cable.",
    "12% of SU11 was not read out: it is below black; 3% of red has no valid pixels, which "
    "coverage counts as a gap. Check head and cable.",
    "The exposure's time is uncertain; check strobe cable and receiver. Fly it again.",
    "Probe and stitching disagree on the temperature of cone C0: probe P1 reads 2.0 K too high, "
    "or sensor SU11 has moved; check the probe after landing.",
    "The frame of SU10 comes from head SU11, the frame of SU11 comes from head SU10, by the fixed "
    "pattern of their pixels: heads or cables are exchanged, and bands or parts of the image are "
    "wrong. Check cables, addresses and serial numbers. The pixels stored are good; process them "
    "again with the frames in their places.",
    "A block of SU11 differs by +14 DN (+2%): an edge after row 812, columns 5 to 900, follows a "
    "line of pixels and no other head shows it. Radiometry of this frame is wrong. Check the head "
    "and its cable.",
    "In the frame of SU11 (or SU12, which sees the same ground), rows 5 to 9 lie 1.2 px off the "
    "rest: lines were lost or repeated in read-out. Also shifted: SU13. Check the head and its "
    "cable. Fly this exposure again.",
    "Motion blur along track; shorten the exposure, check TDI, speed, mount and crab.",
    "60 lines of N from line 205 on repeat those from line 145 on, word by word: they were sent "
    "twice, and the image shows other ground in one of both places. Check the head, cable and "
    "transfer. Fly this exposure again.",
    "Tilted by 4.1 deg, 3.0 deg allowed; fly this part again, level.",
    "Columns 5 to 90, rows 7 to 80 of SU11 (or of SU12 at the same place) show other ground than "
    "the other heads although they have texture: a part of another exposure. Check the head, "
    "cable and transfer. Fly this exposure again.",
    "exposure 7: was stored but not sealed; sealed from the log (mark)",
    "exposure 7: was triggered but never stored; recorded as lost",
    "The signal changes by +8% after line 812 of the rows of SU11: gain or offset changed during "
    "read-out. Radiometry of this frame is wrong. Check the head. 3 frames step while other heads "
    "show no such ground: check what these heads share, supply and clock.",
    "12 m right of line A3 at the next exposure (limit 10 m). Steer left. 40 m above the planned "
    "height (limit 30 m). Descend",
    "the PTP clock of SU11 is not used: its status is LISTENING. Check that the grandmaster runs, "
    "is on the same network, and has the better priority",
    "no edge of the pulse per second for 12 s: the clock coasts, its time is good to 0.2 ms now; "
    "check the PPS cable and the receiver's fix",
    "not armed: GPS time is not known (wait for the receiver's fix; check its antenna); no "
    "temperature of probe 1 (check the probes and their module); override to fly without",
    "Exposure 7: no head sent a frame",
    "exposure 12 rejected; it is to be flown again",
    "gnss: port /dev/ttyUSB0 cannot be opened: there is no such port; check the cable and the "
    "port's name. Retrying automatically.",
    "The head SU11 at 10.0.0.5 was lost (it has not answered for 5 s). Check its power and cable. "
    "Reconnecting automatically.",
    "12 exposures and 156 frames are verified; nothing is wrong",
    "the ledger does not balance: SU11: 3 pending after landing; 2 exposures are open after "
    "landing",
)


def test_a_code_renders_the_sentence_that_it_was_found_for() -> None:
    for sentence in SENTENCES:
        message = message_of(sentence)
        assert message is not None, sentence
        assert english(message) == sentence
        assert not re.search(r"[a-z]{3,} [a-z]{3,} [a-z]{3,}", " ".join(texts_of(message))), message


def test_every_text_of_the_catalog_is_found_by_itself() -> None:
    for code, text in json.loads(CATALOG.read_text("utf-8")).items():
        names = re.findall(r"\{(\w+)\}", text)
        assert len(set(names)) == len(names), code
        sentence = text
        for name in names:
            sentence = sentence.replace(f"{{{name}}}", "7" if name in NUMBERS else f"X{name}")
        message = message_of(sentence)
        if message is None:  # It only joins others.
            assert not re.search(r"[A-Za-z]{3}", re.sub(r"\{\w+\}", "", text)), code
            continue
        assert english(message) == sentence
        assert f"server.{message['code']}" == code, sentence


def test_a_text_where_a_number_is_expected_is_not_this_message() -> None:
    assert message_of("Tilted by much deg, 3.0 deg allowed; fly this part again, level.") is None
    assert message_of("") is None
    assert message_of("x" * 5000) is None


def test_the_records_of_the_api_have_messages_next_to_their_sentences() -> None:
    sentence = "Head SU11 sent no image. Check power and cable."
    message = {"code": "finding.head_missing", "parameters": {"head": "SU11"}}
    record = {
        "faults": [{"sentence": sentence}, {"sentence": "Unknown."}],
        "status": {"missing": ["token rejected", "Unknown."]},
        "landing": {"poweroff": "Unknown."},
    }
    assert with_messages(record)["landing"] == record["landing"]
    record["landing"] = {"poweroff": "token rejected"}
    found = with_messages(record)
    assert found["landing"]["poweroff_message"]["code"] == "command.token_rejected"
    assert found["faults"] == [{"sentence": sentence, "message": message}, {"sentence": "Unknown."}]
    assert found["status"]["missing"] == ["token rejected", "Unknown."]
    assert found["status"]["missing_messages"] == [
        {"code": "command.token_rejected", "parameters": {}},
        "Unknown.",
    ]


def test_a_long_sentence_of_a_device_costs_no_time() -> None:
    """Matching is linear: what a device sends cannot hold up the page."""
    for text in ("; ".join(["a (b"] * 400), "the " * 500, ": " * 900, "(" * 1900, "7 m of " * 250):
        assert message_of(text) is None or english(message_of(text) or {}) == text


def test_every_line_of_a_sentence_is_translated_and_many_lines_are_no_danger() -> None:
    line = (
        "SU07: features.A = 1 is refused (A is 0 and read-only); choose a value that the head has"
    )
    for count in (2, 10, 300):
        text = "\n".join([line] * count)[:SENTENCE_MAX]
        message = message_of(text)
        assert message is not None and english(message) == text
        codes = list(codes_of(message))
        assert count == 300 or codes.count("device.choose_value") == count
    for text in ("a\n" * 900, "SU07: it is lost\n" * 100, "\n" * 1900):
        assert message_of(text) is None or english(message_of(text) or {}) == text


@pytest.mark.parametrize(
    ("sentence", "codes"),
    [
        (
            "SU11 at 10.0.0.5: another program controls the head; end that program. Retrying "
            "automatically.",
            ["device.not_opened", "device.named_error_at", "device.controlled"],
        ),
        (
            "gnss: port /dev/ttyUSB0 cannot be opened: it is in use by gpsd (812); run: systemctl "
            "stop gpsd.socket gpsd, or use driver gpsd",
            [
                *("device.named_error", "device.port_not_opened", "device.port_in_use"),
                "device.use_stop_gpsd",
            ],
        ),
        (
            "SU07 at 10.0.0.7: 4000 us, 6 dB, 0 TDI shifts are refused (GainRaw: out of range); "
            "choose settings within the head's bounds",
            ["device.named_error_at", "device.settings_refused"],
        ),
        (
            "SU02 at /dev/video2: /dev/video2 may not be opened; add this user to the group video",
            ["device.node_forbidden"],
        ),
        (
            "SU02 at /dev/video2: /dev/video2 cannot be opened (Input/output error); check cable "
            "and power. Retrying automatically.",
            ["device.not_opened", "device.node_not_opened"],
        ),
        (
            "thermo: nothing came at /dev/ttyS0 in 3 s; check power, cable, baudrate (9600)",
            ["device.named_error", "device.instrument_silent"],
        ),
        (
            "SU07: serial number is 231 where 232 is configured; another head is connected here, "
            "or serial is wrong",
            ["device.named_error", "device.serial_other"],
        ),
    ],
)
def test_a_refusal_of_a_driver_has_codes_for_all_of_its_parts(
    sentence: str, codes: list[str]
) -> None:
    message = message_of(sentence)
    assert message is not None
    assert list(codes_of(message)) == codes
    assert english(message) == sentence
    for language in ("de", "fr", "es", "zh"):
        catalog = json.loads((CATALOG.parents[1] / language / "server.json").read_text("utf-8"))
        translated = english(message, catalog)
        assert "end that program" not in translated and "; run: " not in translated
