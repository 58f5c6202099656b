"""A reader of somebody's files fed by atheris, which goes where new code is reached: a program of its own.

    pip install '.[fuzz]'
    python tests/toys/coverage_fuzz.py a.csv 20000     # a name of fuzzed_files.READERS, and how many inputs

Begins at the sound file. Ends with exit code 77 and the input in a file here, where one is neither read nor
refused in one line; else with the number of inputs, "Done 20000 runs".
"""

from __future__ import annotations

import sys
import tempfile
import warnings
from pathlib import Path

import atheris

sys.path.insert(0, str(Path(__file__).parents[1]))

with atheris.instrument_imports(include=["bayeskin", "meshio", "openpyxl", "xlrd"]):
    import bayeskin.scripting
    import bayeskin.workflow.serve  # noqa: F401

from toys import fuzzed_files


def main() -> None:
    name, count = sys.argv[1:]
    read, make, _ = fuzzed_files.READERS[name]
    warnings.simplefilter("ignore")
    with tempfile.TemporaryDirectory() as folder:
        corpus, path = Path(folder) / "corpus", Path(folder) / "in" / name
        for needed in (corpus, path.parent):
            needed.mkdir()
        (corpus / "sound").write_bytes(make(Path(folder)))

        def read_bytes(data: bytes) -> None:
            path.write_bytes(data)
            fuzzed_files.refused(read, path)

        atheris.Setup(
            [sys.argv[0], f"-atheris_runs={count}", "-seed=1", "-max_len=65536", str(corpus)], read_bytes
        )
        atheris.Fuzz()


if __name__ == "__main__":
    main()
