"""After landing the page verifies, copies, reports and shuts down, by commands to the service."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.daemon.onboard.monitoring import flight_events
from tests.daemon.onboard.monitoring.page_service import WITHIN_S, Service
from tests.support.browser import Browser, chromium

STEPS = "document.querySelector('[data-step={}]')?.innerText.includes({})"


@pytest.fixture(scope="module")
def landed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Service, Browser, Path]]:
    chromium()
    folder = tmp_path_factory.mktemp("landed")
    mission = folder / "mission"
    (mission / "export").mkdir(parents=True)
    service = Service(folder)
    service.emit(flight_events.mission(str(mission)))
    service.emit(flight_events.status("landed", triggers=1))
    with Browser(folder / "profile") as browser:
        browser.open(service.address)
        browser.wait_for("document.querySelector('#link')?.innerText === 'connected'", WITHIN_S)
        browser.evaluate(f"sessionStorage.setItem('token', {json.dumps(service.token)})")
        yield service, browser, mission
    service.end()


def emit_action(service: Service, action: str, state: str, **content: Any) -> None:
    event = {"event": "landing-action", "mono_ns": "1", "action": action, "by": "operator"}
    service.emit(event | {"state": state, **content})
    service.emit(flight_events.status("landed", triggers=1))


def step(action: str, words: str) -> str:
    return STEPS.format(action, json.dumps(words))


def test_commands_are_listed_until_the_service_offers_them(
    landed: tuple[Service, Browser, Path],
) -> None:
    service, browser, mission = landed
    browser.wait_for(
        "document.querySelectorAll('#landing .next-steps code').length === 4", WITHIN_S
    )
    assert f"syntopic verify {mission}" in browser.text("#landing")
    assert browser.evaluate("document.querySelectorAll('#landing [data-action]').length") == 0
    event = {"event": "landing", "mono_ns": "1", "folders": [], "poweroff": "no helper. Run: x"}
    service.emit(event)
    service.emit(flight_events.status("landed", triggers=1))
    browser.wait_for("document.querySelector('[data-action=verify]') !== null", WITHIN_S)
    assert browser.text("[data-step=shutdown]") == "no helper. Run: x"
    assert "copy_to" in browser.text("[data-step=copy]")


def test_an_action_is_started_once_and_its_progress_and_result_are_shown(
    landed: tuple[Service, Browser, Path],
) -> None:
    service, browser, mission = landed
    event = {"event": "landing", "mono_ns": "1", "folders": ["/media/a", "/media/b"]}
    service.emit(event | {"poweroff": ""})
    service.emit(flight_events.status("landed", triggers=1))
    browser.wait_for("document.querySelectorAll('[data-action=copy]').length === 2", WITHIN_S)
    # A double click: the second one meets a disabled button.
    browser.evaluate(
        "(() => { const one = document.querySelectorAll('[data-action=copy]')[1];"
        " one.click(); one.click(); })()"
    )
    service.until(lambda: len(service.commands) == 1)
    assert (service.commands[0].name, service.commands[0].arguments["folder"]) == (
        "copy",
        "/media/b",
    )
    emit_action(service, "copy", "running", done_bytes=30, total_bytes=120)
    browser.wait_for(step("copy", "runs 25"), WITHIN_S)
    assert browser.evaluate(
        "[...document.querySelectorAll('#landing [data-action]')].every((one) => one.disabled)"
    )
    emit_action(service, "copy", "failed", sentence="the disk is full")
    browser.wait_for(step("copy", "the disk is full"), WITHIN_S)
    emit_action(service, "copy", "done", sentence="7 files copied")
    browser.wait_for(step("copy", "7 files copied"), WITHIN_S)
    assert len(service.commands) == 1
    (mission / "export" / "report.html").write_text("<html>report</html>")
    emit_action(service, "report", "done", sentence="the report is there")
    browser.wait_for("document.querySelector('[data-action=save]') !== null", WITHIN_S)
    fetched = browser.evaluate("fetch('/api/v1/report').then((answer) => answer.text())")
    assert fetched == "<html>report</html>"


def test_the_shutdown_is_confirmed_first(landed: tuple[Service, Browser, Path]) -> None:
    service, browser, _ = landed
    browser.evaluate("document.querySelector('[data-action=shutdown]').click()")
    browser.wait_for("document.querySelector('#ask-confirm').open", WITHIN_S)
    assert [command.name for command in service.commands] == ["copy"]
    browser.evaluate("document.querySelector('#confirm-do').click()")
    service.until(lambda: service.commands[-1].name == "shutdown")
