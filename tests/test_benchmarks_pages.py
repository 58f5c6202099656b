"""Pages of the documentation that benchmarks write, against what is stored."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest
from scipy.stats import binom

from bayeskin.proof import score, seals
from bayeskin.proof.scoring.curves import curve
from bayeskin.types import PHASE_KINDS


def test_the_page_of_mechanisms_has_the_catalogue_as_it_is(benchmark):
    page = Path(__file__).parents[1] / "docs" / "mechanisms.md"
    assert benchmark("catalogue_table").table() in page.read_text()


@pytest.mark.parametrize("data", ["surrogate", "full"])
def test_stored_ranks_are_uniform_and_stand_in_the_documentation(benchmark, data):
    """The rows of `benchmarks/calibration.py` show no parameter whose intervals are certainly wrong."""
    calibration = benchmark("calibration")
    stored = [row for row in calibration.ROWS.read() if (row["data"], row["seed"]) == (data, "1")]
    on_page = []
    for surrogate in sorted({row["surrogate"] for row in stored}):
        chosen = sorted((r for r in stored if r["surrogate"] == surrogate), key=lambda r: int(r["index"]))
        on_page += [chosen[:n] for n in range(len(chosen), 49, -1) if shown(calibration.table(chosen[:n]))]
    assert len(on_page) == 1  # the page has the table of so many
    (chosen,) = on_page
    n = len(chosen)
    for name in calibration.NAMES:
        ranks = np.array([int(row[f"rank_{name}"]) for row in chosen])
        assert calibration.uniformity(ranks) > 0.01 / len(calibration.NAMES), name
        for level in (50, 90):
            held = sum(row[f"in{level}_{name}"] == "True" for row in chosen)
            low, high = binom.ppf([0.0005, 0.9995], n, level / 100)
            assert low <= held <= high, (name, level)


def shown(table: str) -> bool:
    """Returns whether a page of the documentation has the rows of a table."""
    page = (Path(__file__).parents[1] / "docs" / "calibration.md").read_text()
    return all(line in page for line in table.splitlines()[2:])


def test_the_forces_of_the_fresh_cases_are_stored_for_the_present_laws(benchmark):
    """The key of a force has the hash of the laws; docs/reduced.md tells what the cases show."""
    fresh = benchmark("reduced_error")
    cases = fresh.fresh() | {f"outside-{i}": fresh.beyond(i) for i in range(4 * fresh.EACH)}
    with h5py.File(fresh.RESULTS) as stored:
        assert {fresh.key_of(name, case) for name, case in cases.items()} == set(stored)


def test_the_page_of_the_recording_says_what_the_diagnosis_says(benchmark):
    page = benchmark("healthy_skin_page")
    fits = {
        when: {"rmse": rmse, "rmse_held_out": 2.0 * rmse, "coverage90": 0.8,
               "rmse_by_phase": {kind: rmse for kind in PHASE_KINDS},
               "sampled": {"settled": False, "rhat": 1.25}}
        for when, rmse in (("before", 0.07), ("after", 0.0095))
    }  # fmt: skip
    named = {"name": "pad-slip", "probability": 0.97, "contribution_n": 0.04, "statement": "The pads slip."}
    answer = {
        "verdict": "named", "best_set": ["pad-slip"], "explained": 0.98, "smooth_probability": 0.4,
        "seconds": 600.0, "mechanisms": [named], "located": [{}] * 3, "remaining": [{}], "fit": fits,
        "full_model": {"rmse": 0.011, "fit_off_by": 1e-3},
    }  # fmt: skip
    whole = page.fits(answer)
    assert "| 70.0 mN | 9.5 mN | 9 mN |" in whole
    assert "| 140.0 mN | 19.0 mN | 18 mN |" in whole
    assert "RMSE |  | 11.0 mN |" in whole
    assert "| 3 | 1 |" in whole
    assert "it folds" in page.fits({**answer, "full_model": {"message": "it folds"}})
    words = page.named(answer)
    assert "| pad-slip | 0.97 | 40.0 mN | The pads slip. |" in words
    assert "`named`" in words
    assert "R-hat of its draws 1.25 (not settled)" in words
    assert "10 minutes" in words


def test_the_page_of_the_proof_counts_all_sets_and_leaves_out_what_is_not_judged(benchmark, tmp_path):
    page, folder = benchmark("proof_page"), Path(__file__).parents[1] / "data" / "development"
    assert page.judged(folder)
    for path in ("index.json", "verdicts/001.json"):
        (tmp_path / path).parent.mkdir(exist_ok=True)
        shutil.copy(folder / path, tmp_path / path)
    assert not page.judged(tmp_path)
    answers = {
        path.stem: json.loads(path.read_text())["answer"] for path in (folder / "verdicts").glob("*.json")
    }
    board = score(seals.read_keys(folder), answers)
    table = page.nothing({"one": board, "two": board}).splitlines()
    assert [line.split("|")[2].strip() for line in table[2:]] == ["0 of 20", "0 of 20", "0 of 40"]


def test_the_skins_parameters_are_counted_by_what_was_concealed(benchmark):
    page = benchmark("proof_page")

    def verdict(number, kind, label, named, right, size, hits):
        inside = dict(zip(("E_c", "E_s"), hits, strict=True))
        answer = " + ".join(named) or "nothing-missing"
        return {"number": number, "kind": kind, "label": label, "named": named, "answer": answer,
                "right": right, "size": size, "inside_base": inside}  # fmt: skip

    each = [
        verdict("1", "nothing", "nothing", [], False, 0.0, (True, True)),
        verdict("2", "alone", "pad-slip", ["pad-slip"], True, 5.0, (True, False)),
        verdict("3", "alone", "pre-stretch", [], False, 1.0, (False, False)),
        verdict("4", "outside", "peeling", ["pad-slip"], False, 2.0, (False, True)),
    ]
    cells = {
        line.split(" | ")[0].strip("| "): [cell.strip(" |") for cell in line.split(" | ")[1:]]
        for line in page.inside({"one": {"each": each}}).splitlines()[2:]
    }
    assert cells == {
        "nothing": ["1", "1", "1", "2 of 2"],
        "clear, named right": ["1", "1", "0", "1 of 2"],
        "pad-slip": ["1", "1", "0", "1 of 2"],
        "pre-stretch, called nothing": ["1", "0", "0", "0 of 2"],
        "a wrong name": ["1", "0", "1", "1 of 2"],
    }


def test_the_table_of_sizes_tells_clear_effects_from_smaller_ones(benchmark):
    sizes, right = [1.0, 2.0, 4.0, 8.0], [False, True, True, True]
    answers = {"sizes": sizes, "right": right, "up_to": [True] * 4, "curve": curve(sizes, right)}
    line = benchmark("proof_page").sizes({"by_mechanism": {"pad-slip": answers}}).splitlines()[-1]
    cells = [cell.strip() for cell in line.strip("|").split("|")]
    assert cells[:5] == ["pad-slip", "1.0 to 8.0", "2 of 2", "1 of 2", "1"]
