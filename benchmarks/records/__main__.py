"""`python -m benchmarks.records`: write the records of measurements into the documents."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

from benchmarks.records import ROOT, RecordError, all_records, documents, updated


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.records", description=__doc__)
    parser.add_argument("--check", action="store_true", help="Write nothing; fail if one differs.")
    options = parser.parse_args(arguments)
    try:
        records = all_records()
        changed = []
        for document in documents():
            text = document.read_text(encoding="utf-8")
            new = updated(text, document, records)
            if new != text:
                changed.append(document.relative_to(ROOT).as_posix())
                if not options.check:
                    document.write_text(new, encoding="utf-8")
    except RecordError as error:
        print(error, file=sys.stderr)
        return 2
    for name in changed:
        print(f"{name}: {'not up to date' if options.check else 'written'}")
    return 1 if changed and options.check else 0


if __name__ == "__main__":
    sys.exit(main())
