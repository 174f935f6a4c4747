"""Words and phrases of `tests.repository.vocabulary` stand nowhere; each exception is needed."""

import ast
import re
import subprocess

from tests.repository.vocabulary import (
    ALLOWED,
    ALLOWED_NAMES,
    ROOT,
    names_in,
    occurrences,
    phrases_in,
    replacement,
)


def test_no_word_to_avoid_is_used() -> None:
    found = [
        f"{one.path}:{one.line}: {one.word}: write {replacement(one.word)}" for one in occurrences()
    ]
    assert found == []


def test_every_exception_is_needed() -> None:
    for path, word in ALLOWED:
        text = (ROOT / path).read_text("utf-8").lower()
        assert word in text, (path, word)


def test_every_exception_of_a_name_is_needed() -> None:
    for path, name in ALLOWED_NAMES:
        text = (ROOT / path).read_text("utf-8")
        assert re.search(rf"(?:class|def) {name}\b", text), (path, name)


def test_a_phrase_is_found_across_lines() -> None:
    for text in (
        "The brightest hundredth stayed.",
        "the brightest\nhundredth",
        "# of the brightest\n# hundredth",
        '"the brightest "\n    "hundredth"',
        '"the Brightest "\n    f"hundredth {x}"',
    ):
        assert [one.word for one in phrases_in("a.md", text)] == ["brightest hundredth"], text
    assert list(phrases_in("a.md", "The brightest of a hundred stayed.")) == []


def test_a_name_of_a_class_or_function_is_found() -> None:
    text = "class FilesMade:\n    def turn_of(self): ...\n\nasync def kept(): ...\n"
    assert {one.word for one in names_in("a.py", text)} == {"made", "turn", "kept"}
    plain = "def test_a_turn_is_made(): ...\n\ndef rotation(): return 'kept'\n"
    assert list(names_in("a.py", plain)) == []


def test_public_class_names_are_unique() -> None:
    listed = subprocess.run(
        [
            "git",
            "grep",
            "-hoE",
            r"^class [A-Z]\w+",
            "--",
            "daemon",
            "drivers",
            "processing",
            "sim_hw",
        ],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
        timeout=60,
    ).stdout.split("\n")
    names = [line.partition(" ")[2] for line in listed if line]
    twice = sorted({name for name in names if names.count(name) > 1})
    assert twice == []


UNIT_SUFFIX = {
    **dict.fromkeys(("seconds", "secs", "sec"), "s"),
    **dict.fromkeys(("milliseconds", "millis", "msec"), "ms"),
    **dict.fromkeys(("microseconds", "micros", "usec"), "us"),
    **dict.fromkeys(("nanoseconds", "nanos", "nsec"), "ns"),
    **dict.fromkeys(("metres", "meters"), "m"),
    **dict.fromkeys(("millimetres", "millimeters"), "mm"),
    **dict.fromkeys(("micrometres", "micrometers", "microns"), "um"),
    **dict.fromkeys(("degrees", "degs"), "deg"),
    **dict.fromkeys(("radians", "rads"), "rad"),
    **dict.fromkeys(("celsius", "degc", "deg_c"), "c"),
    **dict.fromkeys(("pix", "pxl"), "px"),
    **dict.fromkeys(("hertz",), "hz"),
    **dict.fromkeys(("pct",), "percent"),
}
# A term; fields of MAVLink; fields of the kernel.
FOREIGN_NAMES = ("leap_seconds", "time_usec", "time_unix_usec", "tv_sec", "tv_usec")


def test_a_unit_has_one_suffix_in_names() -> None:
    found = []
    for package in ("daemon", "drivers", "processing", "sim_hw"):
        for path in sorted((ROOT / package).rglob("*.py")):
            for node in ast.walk(ast.parse(path.read_text("utf-8"))):
                if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
                    name = node.target.id
                elif isinstance(node, ast.arg):
                    name = node.arg
                else:
                    continue
                stem, _, suffix = name.lower().rpartition("_")
                if stem and suffix in UNIT_SUFFIX and not name.lower().endswith(FOREIGN_NAMES):
                    place = f"{path.relative_to(ROOT)}:{node.lineno}"
                    found.append(f"{place}: {name}; write _{UNIT_SUFFIX[suffix]}")
    assert not found, "\n".join(found)
