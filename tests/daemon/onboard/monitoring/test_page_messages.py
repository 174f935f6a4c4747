"""Sentences of the service on the page: in the language of the page, none left in English."""

from __future__ import annotations

import json
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import pytest

from daemon.onboard.monitoring.server_messages import english, message_of
from daemon.onboard.monitoring.web.page_files import PAGE
from tests.daemon.onboard.monitoring import flight_events
from tests.daemon.onboard.monitoring.page_service import WITHIN_S, Service
from tests.support.browser import Browser, chromium

LOST = (
    "The head SU03 at 10.0.0.5 was lost (it has not answered for 5 s). Check its power and cable. "
    "Reconnecting automatically."
)
DISK = "disk b (/disk): its health was not read lately; look at the timer"
NO_IMAGE = "Head SU03 sent no image. Check power and cable."
MISSING = "GPS time is not known (wait for the receiver's fix; check its antenna)"
REFUSED = f"not armed: {MISSING}; override to fly without"
NO_FRAME = "no head sent a frame"
RECOVERED = "exposure 7: was stored but not sealed; sealed from the log (mark)"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    chromium()
    return tmp_path_factory.mktemp("messages")


@pytest.fixture(scope="module")
def service(folder: Path) -> Iterator[Service]:
    service = Service(folder)
    service.emit(flight_events.mission() | {"recovery": [RECOVERED]})
    service.emit({"event": "bound", "device": "SU03", "kind": "head", "found": {}})
    service.emit(flight_events.device_event("SU03", "lost", LOST, fault=True))
    service.emit({"event": "disk-health", "disk": "b", "fault": True, "sentence": DISK})
    for event in flight_events.exposure(1):
        service.emit(event)
    service.emit(
        {
            "event": "judged",
            "number": 1,
            "report": {
                "verdict": "usable",
                "flags": ["FRAME_MISSING"],
                "findings": [
                    {"flag": "FRAME_MISSING", "sentence": NO_IMAGE, "verdict": "usable"},
                    {"flag": "X", "sentence": "Words without a code.", "verdict": "usable"},
                ],
            },
        }
    )
    service.emit({"event": "lost", "number": 2, "cause": NO_FRAME})
    service.emit(flight_events.status("ready", 2) | {"missing": [MISSING]})
    yield service
    service.end()


@pytest.fixture(scope="module")
def browser(folder: Path, service: Service) -> Iterator[Browser]:
    with Browser(folder / "profile") as browser:
        yield browser


def in_language(language: str, sentence: str) -> str:
    catalog = json.loads((PAGE / f"messages/{language}/server.json").read_text("utf-8"))
    message = message_of(sentence)
    assert message is not None
    return english(message, catalog)


def open_in(browser: Browser, service: Service, language: str) -> None:
    browser.open(f"{service.address}?lang={language}")
    browser.wait_for("document.querySelectorAll('#faults [data-fault]').length >= 2", WITHIN_S)
    browser.wait_for("document.querySelector('#findings li') !== null", WITHIN_S)


@pytest.mark.parametrize("language", ["en", "de", "fr", "es", "zh"])
def test_sentences_of_the_service_are_shown_in_the_language_of_the_page(
    service: Service, browser: Browser, language: str
) -> None:
    open_in(browser, service, language)
    for fault, sentence in (("device SU03", LOST), ("health of disk b", DISK)):
        item = f"document.querySelector('[data-fault=\"{fault}\"]')"
        assert in_language(language, sentence) in browser.evaluate(f"{item}.textContent")
        spoken = f"[...{item}.querySelectorAll('[lang]')].map((one) => one.lang)"
        assert browser.evaluate(spoken) == [language]
    device = browser.evaluate("document.querySelector('[data-device=SU03]').textContent")
    assert in_language(language, LOST) in device
    # The newest exposure is the lost one; its cause stands where findings of others stand.
    assert in_language(language, NO_FRAME) in browser.text("#findings")
    for listed, sentence in (("#missing", MISSING), ("#recovery", RECOVERED)):
        text = browser.evaluate(f"document.querySelector('{listed}').textContent")
        assert in_language(language, sentence) in text


def test_an_answer_and_what_is_missing_are_shown_in_the_language_of_the_page(
    service: Service, browser: Browser
) -> None:
    open_in(browser, service, "de")
    browser.evaluate(f"sessionStorage.setItem('token', {json.dumps(service.token)})")
    service.refusal = REFUSED
    browser.evaluate("import('/commands.js').then((one) => { one.command('arm'); })")
    for _ in range(2):
        if service.commands:
            break
        service.until(lambda: bool(service.commands))
    browser.wait_for("document.querySelector('#answer').textContent !== ''", WITHIN_S)
    answer = browser.evaluate("document.querySelector('#answer').textContent")
    assert answer == f"{in_language('de', 'Not possible now')}: {in_language('de', REFUSED)}"
    browser.wait_for("document.querySelector('#missing-items li') !== null", WITHIN_S)
    listed = browser.evaluate("document.querySelector('#missing-items').textContent")
    assert listed == in_language("de", MISSING)
    browser.evaluate("document.querySelector('#ask-override').close('')")


def test_no_english_sentence_of_the_service_stays_in_the_pseudo_language(
    service: Service, browser: Browser
) -> None:
    """A text of the catalogs has accents; a sentence without a code keeps its plain letters."""
    open_in(browser, service, "qps")
    for selector in (
        "#faults",
        "#findings",
        "#missing",
        "#recovery",
        "#devices",
        "#alarm-bar",
        "#rows",
    ):
        plain = browser.evaluate(
            f"""(() => {{
              const found = [];
              for (const root of document.querySelectorAll({json.dumps(selector)})) {{
                const walker = document.createTreeWalker(root, NodeFilter.SHOW_TEXT);
                while (walker.nextNode()) found.push(walker.currentNode.textContent);
              }}
              return found.filter((text) => /[a-z]{{3,}} [a-z]{{2,}} [a-z]{{2,}}/i.test(text));
            }})()"""
        )
        assert plain == [], selector


def test_the_api_sends_codes_and_parameters_next_to_the_sentence(service: Service) -> None:
    with urllib.request.urlopen(f"{service.address}api/v1/exposures/1", timeout=30) as response:
        known, unknown = json.load(response)["findings"]
    assert known["sentence"] == NO_IMAGE
    assert known["message"] == {"code": "finding.head_missing", "parameters": {"head": "SU03"}}
    assert "message" not in unknown
    with urllib.request.urlopen(f"{service.address}api/v1/faults", timeout=30) as response:
        faults = {one["id"]: one for one in json.load(response)}
    assert faults["device SU03"]["message"]["code"] == "device.head_lost"
    assert faults["exposure 2"]["message"]["parameters"]["number"] == "2"
