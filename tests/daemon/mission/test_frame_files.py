"""A frame under a name spelt otherwise is taken or refused, never passed over."""

import pytest

from daemon.mission.canonical_json import RecordError
from daemon.mission.store.frame_files import frame_files, other_spelling

pytestmark = pytest.mark.trust
SENSORS = ("SU30", "B", "b")


def laid_out(folder, *names):
    folder.mkdir(exist_ok=True)
    for name in names:
        (folder / name).touch()
    return folder


@pytest.mark.parametrize("name", ["SU30.tif", "SU30.TIF", "SU30.tiff", "su30.Tiff"])
def test_every_spelling_of_a_suffix_is_found(tmp_path, name):
    assert frame_files(laid_out(tmp_path, name), SENSORS) == {"SU30": name}


def test_case_distinguishes_sensors_where_the_rig_does(tmp_path):
    folder = laid_out(tmp_path, "b.tif", "B.tif")
    assert frame_files(folder, SENSORS) == {"B": "B.tif", "b": "b.tif"}


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (("SU30.tif", "SU30.TIF"), "SU30.TIF and SU30.tif are both frames of SU30; keep one"),
        (("SU30.tif", "SU3O.tif"), "SU3O.tif: no sensor of the rig has this name"),
        (("su30.tif", "Su30.tif"), "are both frames of SU30"),
        (("SU30.tif", "su30.tif"), "su30.tif: no sensor of the rig has this name"),
    ],
)
def test_an_ambiguous_file_is_refused(tmp_path, names, expected):
    with pytest.raises(RecordError, match=expected):
        frame_files(laid_out(tmp_path, *names), SENSORS)


def test_other_files_are_none_of_its_business(tmp_path):
    assert frame_files(laid_out(tmp_path, "exposure.json", "notes.txt"), SENSORS) == {}


def test_a_missing_file_has_its_other_spelling_named(tmp_path):
    laid_out(tmp_path, "SU30.TIF", "G.txt")
    assert other_spelling(tmp_path / "SU30.tif") == "SU30.TIF"
    assert other_spelling(tmp_path / "G.tif") is None
    assert other_spelling(tmp_path / "none" / "G.tif") is None
