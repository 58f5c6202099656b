"""Verdicts of the proof: diagnoses that fail, are interrupted, or are made again by other sources."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from toys.quick_proof import COUNT, SEED, nothing_found

import bayeskin
from bayeskin import report
from bayeskin.errors import InputError
from bayeskin.proof import scoring_history
from bayeskin.workflow import proof as pipeline
from bayeskin.workflow.diagnosing_sources import imported
from bayeskin.workflow.engine import Silent
from bayeskin.workflow.folder import locked


@pytest.fixture(autouse=True)
def quickly(monkeypatch: pytest.MonkeyPatch) -> None:
    """Draws no scoreboard, and takes the sources' hash as read: both are tested elsewhere."""
    monkeypatch.setattr(report, "save_figure", lambda figure, stem, stamp: [])
    monkeypatch.setattr(pipeline, "diagnosing_sources", lambda: "these")


def test_a_diagnosis_that_fails_ends_no_set(concealed_set: Path, tmp_path: Path) -> None:
    def fails(sources: list[Path], reporter) -> dict:
        failing = len(seen)
        seen.append(sources[0])
        if failing == 0:
            raise InputError("priors", "none but impossible skins", "others")
        if failing == 2:
            raise np.linalg.LinAlgError("singular")
        return (
            {"ok": False, "message": "design: all runs failed"}
            if failing == 1
            else nothing_found(sources, reporter)
        )

    seen: list[Path] = []
    copy = Path(shutil.copytree(concealed_set, tmp_path / "copy"))
    board = pipeline.prove(copy, Silent(), diagnose=fails)["scoreboard"]
    assert (len(seen), board["judged"]) == (COUNT, COUNT)
    assert [verdict["answer"] for verdict in board["each"]][:3] == ["failed", "failed", "failed"]
    again = pipeline.prove(copy, Silent(), diagnose=fails)[
        "scoreboard"
    ]  # those three once more, and no other
    assert len(seen) == COUNT + 3
    assert "failed" not in [verdict["answer"] for verdict in again["each"]]


def test_a_set_is_worked_on_by_one_process(concealed_set: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(concealed_set, tmp_path / "set"))
    with locked(copy):
        with pytest.raises(InputError, match=r"another bayeskin \(process \d+\)"):
            pipeline.prove(copy, Silent(), diagnose=nothing_found)
        with pytest.raises(InputError, match="another bayeskin"):
            pipeline.conceal(copy, SEED, COUNT, Silent())
    assert pipeline.prove(copy, Silent(), diagnose=nothing_found)["scoreboard"]["judged"] == COUNT
    with locked(copy):  # nothing is left to be diagnosed, and a score takes no turns
        assert pipeline.prove(copy, Silent(), diagnose=nothing_found)["scoreboard"]["judged"] == COUNT


def test_a_set_that_is_no_set_is_told(tmp_path: Path) -> None:
    for text in ("[]", '{"recordings": []}', '{"recordings": {"001": {}}}'):
        (tmp_path / "index.json").write_text(text)
        with pytest.raises(InputError, match="index"):
            pipeline.prove(tmp_path, Silent(), diagnose=nothing_found)


def test_a_set_without_its_seals_is_not_made_again(concealed_set: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(concealed_set, tmp_path / "copy"))
    shutil.rmtree(copy / "seals")
    before = (copy / "index.json").read_text()
    with pytest.raises(InputError, match="without its seals"):
        pipeline.conceal(copy, SEED, COUNT, Silent())
    assert (copy / "index.json").read_text() == before


def test_another_verdict_is_a_failure_of_the_same_sources_only(
    concealed_set: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def other(sources: list[Path], reporter) -> dict:
        return {**nothing_found(sources, reporter), "verdict": "unknown"}

    copy = Path(shutil.copytree(concealed_set, tmp_path / "copy"))
    pipeline.prove(copy, Silent(), diagnose=nothing_found)
    again = pipeline.prove(copy, Silent(), rediagnose=1, diagnose=other)
    assert (again["ok"], list(again["rediagnosed_the_same"].values())) == (False, [False])
    assert "ANOTHER VERDICT" in again["text"]
    assert pipeline.prove(copy, Silent(), rediagnose=2, diagnose=nothing_found)["ok"]
    monkeypatch.setattr(pipeline, "diagnosing_sources", lambda: "others")
    compared = pipeline.prove(copy, Silent(), rediagnose=1, diagnose=other)
    assert (compared["ok"], list(compared["rediagnosed_of_these_sources"].values())) == (True, [False])
    assert "another verdict than the stored one, which other sources gave" in compared["text"]


def test_a_scoring_by_another_scorer_is_recorded(
    concealed_set: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    copy = Path(shutil.copytree(concealed_set, tmp_path / "copy"))

    def recorded() -> int:
        pipeline.prove(copy, Silent(), diagnose=nothing_found)
        return len(json.loads((copy / "scorings.json").read_text()))

    once = recorded()
    assert recorded() == once
    hashed = scoring_history.sha256_of_input
    monkeypatch.setattr(
        scoring_history,
        "sha256_of_input",
        lambda path: "other" if path.name == "judgement.py" else hashed(path),
    )
    assert recorded() == once + 1


def test_a_verdict_is_of_all_modules_that_a_diagnosis_loads_and_of_no_others() -> None:
    package = Path(bayeskin.__file__).parent
    script = (
        "import sys\nfrom bayeskin.workflow import diagnosis\n"
        "print(*(m.__file__ for n, m in sys.modules.items() if n.split('.')[0] == 'bayeskin'), sep='\\n')"
    )
    ended = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    loaded = {Path(line).relative_to(package).as_posix() for line in ended.stdout.split()}
    counted = {file.relative_to(package).as_posix() for file in imported(package / "workflow/diagnosis.py")}
    without_effect = ("report/", "proof/", "study/")  # figures, and what only figures and proofs load
    assert {file for file in loaded if not file.startswith(without_effect)} <= counted
    assert {"mismatch/search.py", "finite_element/lagrangian.py", "surrogates/files.py"} <= counted
    others = {
        "cli/__init__.py",
        "cli/mismatch.py",
        "workflow/proof.py",
        "workflow/serve.py",
        "scripting.py",
        "sensitivity/shapley.py",
    }
    assert all((package / file).is_file() for file in others)
    assert not counted & others


def test_prove_goes_on_where_it_was_interrupted_and_records_one_scoring(
    concealed_set: Path, tmp_path: Path
) -> None:
    copy, seen = Path(shutil.copytree(concealed_set, tmp_path / "copy")), []

    def stops_at_third(sources: list[Path], reporter) -> dict:
        seen.append(sources[0])
        if len(seen) == 3:
            raise KeyboardInterrupt
        return nothing_found(sources, reporter)

    with pytest.raises(KeyboardInterrupt):
        pipeline.prove(copy, Silent(), diagnose=stops_at_third)
    assert sorted(p.name for p in (copy / "verdicts").iterdir()) == ["001.json", "002.json"]
    document = pipeline.prove(copy, Silent(), diagnose=stops_at_third)
    assert len(seen) == COUNT + 1
    assert document["ok"]
    assert document["verdicts_of_these_sources"] == COUNT
    pipeline.prove(copy, Silent(), diagnose=stops_at_third)
    assert len(json.loads((copy / "scorings.json").read_text())) == 1
    assert len(seen) == COUNT + 1
