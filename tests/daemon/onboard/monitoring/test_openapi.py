"""schemathesis sends requests that the OpenAPI document allows to the API."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings

from daemon.onboard.monitoring.web.api import AccessSettings, create_app
from tests.daemon.onboard.monitoring import flight_events
from tests.daemon.onboard.monitoring.test_api import Camera

EXAMPLES = 30
schemathesis = pytest.importorskip("schemathesis", reason="pip install schemathesis")


@pytest.fixture(scope="module")
def camera(tmp_path_factory: pytest.TempPathFactory) -> Camera:
    folder: Path = tmp_path_factory.mktemp("api")
    product = folder / "mission/L2/000001"
    product.mkdir(parents=True)
    (product / "quicklook.jpg").write_bytes(b"\xff\xd8jpeg")
    (folder / "mission/service.toml").write_text("[mission]\n")
    camera = Camera(folder)
    for event in (
        *flight_events.exposure(1),
        flight_events.status(triggers=1),
        flight_events.lost("SU02"),
    ):
        camera.state.apply(event)
    return camera


def test_every_response_follows_the_openapi_document(camera: Camera) -> None:
    app = create_app(camera.state, camera.gateway, AccessSettings(camera.tokens))
    operations = list(schemathesis.openapi.from_asgi("/openapi.json", app).get_all_operations())
    assert len(operations) >= 11

    for operation in operations:

        @settings(max_examples=EXAMPLES, deadline=None, suppress_health_check=list(HealthCheck))
        @given(operation.ok().as_strategy())
        def request(case: Any) -> None:
            token = {"Authorization": f"Bearer {camera.operator}"}
            answer = case.call(headers=token)
            assert answer.status_code < 500, (case.method, case.path, answer.text)
            case.validate_response(answer, headers=token)

        request()
