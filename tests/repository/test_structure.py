"""The counts of the structure on a small tree whose counts are known."""

from __future__ import annotations

from pathlib import Path

from tests.repository.structure import structure

MODULE = '''
class Same:
    """A class."""

    def described(self, x_px):
        """F.

        Args:
            x_px: it.
        """

    def not_described(self, x_px) -> int:
        """F."""


def many(a, b, c, d, e, f, g, h, i, j, k, l, m):
    """F."""
'''


def test_a_small_tree_is_counted(tmp_path: Path) -> None:
    for package in ("daemon", "drivers", "processing", "sim_hw", "tests"):
        (tmp_path / package).mkdir()
    (tmp_path / "processing" / "first.py").write_text(MODULE)
    (tmp_path / "processing" / "second.py").write_text("class Same:\n    pass\n" + "\n" * 60)
    (tmp_path / "processing" / "py.typed").write_text("")
    (tmp_path / "README.md").write_text("Nobody h" + "eard it.\n")
    found = structure(tmp_path)
    assert found["words to avoid"] == 1
    assert found["public classes with the name of another"] == 1
    assert (found["entries of processing/"], found["entries of daemon/"]) == (2, 0)
    assert found["files under 50 lines"] == 1
    assert found["functions of more than 12 parameters"] == 1
    assert found["lines of Python"] == MODULE.count("\n") + 62
    assert found["docstrings with Args, percent"] == 33.3
    assert found["docstrings with Returns, percent"] == 0.0
