"""`syntopic process` of a rig that no pipeline is for."""

from pathlib import Path

import pytest
from typer.testing import CliRunner

from daemon.cli import app
from daemon.configuration.model import ConfigurationError
from tests.daemon.small_camera import new_mission


def test_a_rig_of_no_known_kind_is_refused_with_the_missing_section(tmp_path: Path) -> None:
    mission = new_mission(tmp_path)
    with pytest.raises(ConfigurationError) as refused:
        CliRunner().invoke(app, ["process", str(mission.path)], catch_exceptions=False)
    (problem,) = refused.value.problems
    assert "rig small" in problem and "[virtual_image]" in problem
