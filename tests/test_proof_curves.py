"""Curves of the share that is named against size, and the proof's figures."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from toys.made_up_verdicts import key, made_up, said

from bayeskin import report
from bayeskin.proof import score
from bayeskin.proof.scoring.curves import curve
from bayeskin.report import half_in_words


def test_nine_of_ten_curves_have_the_half_that_their_answers_were_drawn_with() -> None:
    rng, inside = np.random.default_rng(4), 0
    for _ in range(30):
        sizes = np.exp(rng.uniform(np.log(0.5), np.log(30.0), 30))
        named = rng.random(30) < 1.0 / (1.0 + (3.0 / sizes) ** 2.5)
        half = curve(sizes.tolist(), named.tolist())["half"]
        inside += half["low"] < 3.0 < half["high"]
    assert 24 <= inside <= 30


def test_a_curve_of_many_answers_is_the_share_that_they_were_drawn_with() -> None:
    rng = np.random.default_rng(5)
    sizes = np.exp(rng.uniform(np.log(0.5), np.log(30.0), 1000))
    fitted = curve(sizes.tolist(), (rng.random(1000) < 1.0 / (1.0 + (3.0 / sizes) ** 2.5)).tolist())
    at, mean = np.array(fitted["at"]), np.array(fitted["mean"])
    np.testing.assert_allclose(mean, 1.0 / (1.0 + (3.0 / at) ** 2.5), atol=0.1)
    assert np.all(np.array(fitted["low"]) <= mean)
    assert np.all(mean <= np.array(fitted["high"]))


def test_a_curve_of_few_answers_is_wide_and_those_alike_say_one_side_only() -> None:
    few, all_named = curve([1.0, 2.0, 4.0, 8.0], [False, False, True, True]), curve([2.0] * 4, [True] * 4)
    assert few["half"]["low"] < 2.0
    assert few["half"]["high"] > 4.0
    assert all_named["half"]["high"] < 3.0
    assert all_named["half"]["low"] < 0.2


def test_only_mechanisms_with_several_recordings_have_a_curve() -> None:
    keys = {f"{i:03d}": key("device-friction", size=float(i)) for i in (1, 2, 4, 8)}
    keys["009"] = key("pad-slip")
    answers = {number: said("device-friction" if number > "002" else "viscous-drag") for number in keys}
    by_name = score(keys, answers)["by_mechanism"]
    assert list(by_name) == ["device-friction"]
    friction = by_name["device-friction"]
    assert (friction["sizes"], friction["right"]) == ([1.0, 2.0, 4.0, 8.0], [False, False, True, True])
    assert friction["up_to"] == [True] * 4
    assert half_in_words(friction).endswith(")")


def test_no_half_is_told_beyond_the_sizes_that_there_were() -> None:
    def words(named: bool) -> str:
        return half_in_words({"sizes": [2.0, 4.0], "curve": curve([2.0, 4.0], [named] * 2)})

    assert words(True).startswith("below")
    assert words(False).startswith("above")


def test_the_figure_of_sizes_is_drawn(tmp_path: Path) -> None:
    sizes, right = [1.0, 2.0, 4.0, 8.0], [False, False, True, True]
    answers = {
        "sizes": sizes,
        "right": right,
        "up_to": [True, False, True, True],
        "curve": curve(sizes, right),
    }
    figure = report.figure_detectability({name: answers for name in ("pad-slip", "pre-stretch", "a", "b")})
    png, _ = report.save_figure(figure, tmp_path / "sizes", "test")
    assert png.stat().st_size > 10_000


def test_the_scoreboard_s_figure_is_drawn(tmp_path: Path) -> None:
    png, svg = report.save_figure(report.figure_proof(score(*made_up())), tmp_path / "board", "test")
    assert png.stat().st_size > 10_000
    assert svg.is_file()
