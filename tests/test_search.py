"""A search on a skin in closed form: the mechanisms that it names, and its tasks."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from functools import cache

import numpy as np
import pytest
from toys import closed_form_reduced
from toys.closed_form_reduced import BASE, KNOWN

from bayeskin.errors import InputError
from bayeskin.mismatch.answers import answer, read_answer
from bayeskin.mismatch.context import DiagnosisContext
from bayeskin.mismatch.further_maxima import fit_larger_sets
from bayeskin.mismatch.hypotheses import weight
from bayeskin.mismatch.search import Searcher, search
from bayeskin.mismatch.search_context import SearchContext
from bayeskin.mismatch.search_record import SearchRecord, SearchResult
from bayeskin.mismatch.search_settings import SearchSettings
from bayeskin.mismatch.tasks import (
    EvidenceTask,
    FitTask,
    FitWithAddedTask,
    FullRunTask,
    RunTask,
    ScoreTestTask,
    Task,
)
from bayeskin.mismatch.wrapper import innermost
from bayeskin.types import Array, ParameterSpace

Full = Callable[[Mapping[str, float]], Array | str]


def exact(values: Mapping[str, float]) -> Array:
    """The full model where the reduced one is exact."""
    return closed_form_reduced.means(values)[0]


FEW = SearchSettings(skins=8, starts=2, best=1, others=4, tried=1, alike=1, runs=6)
QUICK = replace(FEW, ends=(), shapes=0)  # further maxima are sought from two starts only


class Asked:
    """Answers tasks as processes do, through JSON, and keeps them."""

    def __init__(self, bench: DiagnosisContext, lost: Callable[[Task], bool] = lambda task: False) -> None:
        self.bench, self.lost = bench, lost
        self.tasks: list[Task] = []
        self.told: list[str] = []

    def __call__(self, tasks: Sequence[Task]) -> list[object]:
        return [self.answer(task) for task in tasks]

    def answer(self, task: Task) -> object:
        self.tasks.append(task)
        said = {"message": "the worker ended"} if self.lost(task) else answer(self.bench, task)
        return read_answer(self.bench, task, json.loads(json.dumps(said)))

    def search(self, seed: int = 1, settings: SearchSettings = QUICK) -> SearchResult:
        bench, tell = self.bench, self.told.append
        solves = bench.forward.solves
        return search(self, bench.binned, bench.base, KNOWN, solves, bench.noise, seed, tell, settings)


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> Callable[..., Asked]:
    """Answers tasks on a recording of the toy with mechanisms of these values."""

    def make(
        seed: int = 0, lost: Callable[[Task], bool] = lambda task: False, full: Full = exact, **values: float
    ) -> Asked:
        recorded = closed_form_reduced.recorded(seed, **values)
        return Asked(closed_form_reduced.bench(monkeypatch, recorded, full=full), lost)

    return make


Make = Callable[..., Asked]


@pytest.fixture(scope="module")
def searched() -> Callable[..., tuple[Asked, SearchResult]]:
    """Searches a recording of the full model with mechanisms of these values; each search is made once.

    It ends where the sets are weighed: further maxima have a search of their own below.
    """

    @cache
    def make(full: Full = exact, seed: int = 0, **values: float) -> tuple[Asked, SearchResult]:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("bayeskin.mismatch.search.find_further_maxima", lambda *_: None)
            binned = closed_form_reduced.recorded(seed, **values)
            left_out_n = full(closed_form_reduced.TRUTH) - exact(closed_form_reduced.TRUTH)
            binned = replace(binned, force_n=binned.force_n + left_out_n)
            toy = Asked(closed_form_reduced.bench(patch, binned, full=full))
            return toy, toy.search()

    return make


Searched = Callable[..., tuple[Asked, SearchResult]]
DRIFT = {"drift": 3e-4}
BOTH = {"stiffness_rate": 9e-4, "F0": -0.03}


def names_of(task: Task) -> tuple[str, ...]:
    """The set that a task is to fit or to run."""
    asked = task.score_test if isinstance(task, FitWithAddedTask) else task
    more = (asked.name,) if isinstance(asked, ScoreTestTask) else ()
    return tuple(sorted({*asked.names, *more}))


@pytest.mark.parametrize(
    ("values", "names"),
    [
        (DRIFT, ("sensor-drift",)),
        ({"stiffness_rate": -9e-4, "stiffness_time": 200.0}, ("stiffness-drift",)),
        (BOTH, ("force-offset", "stiffness-drift")),
    ],
    ids=["drift", "tissue", "both"],
)
def test_what_is_concealed_is_found(
    searched: Searched, values: dict[str, float], names: tuple[str, ...]
) -> None:
    toy, result = searched(**values)
    best = result.best.fit
    assert best.names == names
    assert weight(best) > max(weight(other.fit) for other in result.fits.values() if other.fit is not best)
    for name in ("F0", "drift", "stiffness_rate"):
        if name in values:
            at = best.log_posterior.names.index(name)
            low, high = best.log_posterior.bounds
            sd = np.sqrt(best.covariance[at, at]) * (high - low)[at]
            assert abs(best.theta[name] - values[name]) < 4.0 * sd
            assert sd < 0.5 * abs(values[name])
    assert any("predicted gains: " in line for line in toy.told)


@pytest.mark.parametrize("rate", [-9e-4, 9e-4])
def test_a_mechanism_of_the_tissue_is_fitted_from_what_its_probes_promise(
    searched: Searched, rate: float
) -> None:
    toy, _ = searched(stiffness_rate=rate, stiffness_time=200.0)
    starts = [task.start for task in toy.tasks
              if isinstance(task, FitTask) and task.names == ("stiffness-drift",)]  # fmt: skip
    assert 0.5 < starts[0]["stiffness_rate"] / rate < 1.5


def test_nothing_is_found_where_nothing_is_concealed(searched: Searched) -> None:
    for seed in range(3):
        _, result = searched(seed=seed)
        assert result.best.fit.names == ()
        np.testing.assert_allclose(
            result.best.fit.mean_n, closed_form_reduced.means(closed_form_reduced.TRUTH)[0], atol=6e-3
        )


def test_no_task_is_asked_twice_and_only_what_is_taken_is_fitted_from_other_skins(searched: Searched) -> None:
    toy, result = searched(**BOTH)
    assert set(Counter(key(task) for task in toy.tasks).values()) == {1}
    fitted = {names_of(task) for task in toy.tasks if isinstance(task, FitTask | FitWithAddedTask)}
    assert fitted == set(result.fits)
    probes = [task for task in toy.tasks if isinstance(task, RunTask)]
    drawn = {task.theta["p_init"] for task in probes if task.names == ()}  # skins that the base was run with
    assert len(drawn) > 4
    skins = {task.names for task in probes if task.theta["p_init"] in drawn}
    assert skins == {(), ("force-offset",)}  # both together leave nothing but noise


MIDDLE = 0.5 * (closed_form_reduced.EDGES_S[1:] + closed_form_reduced.EDGES_S[:-1])
SHAPE = 3e-3 * np.sin(MIDDLE / 3.0)  # what the reduced model leaves out: RMS twice the noise


def more(values: Mapping[str, float]) -> Array:
    """A full model of which the reduced one leaves something out."""
    return exact(values) + SHAPE


@pytest.mark.parametrize("values", [{}, BOTH], ids=["nothing", "two"])
def test_sets_are_compared_by_forces_that_runs_of_the_full_model_correct(
    searched: Searched, values: dict[str, float]
) -> None:
    """The recording is the full model's; what the reduced one leaves out of it is no mismatch."""
    toy, result = searched(more, **values)
    best = result.best
    assert best.fit.names == tuple(sorted({"F0": "force-offset", "stiffness_rate": "stiffness-drift"}[name]
                                          for name in values))  # fmt: skip
    np.testing.assert_allclose(best.correction_n, SHAPE, atol=1e-6)
    check = result.checks[best.fit.names]
    assert check.off < 1e-6
    np.testing.assert_array_equal(check.theta, best.run.theta)
    np.testing.assert_allclose(check.full_n, best.run.force_n, atol=1e-6)
    full = Counter(task.names for task in toy.tasks if isinstance(task, FullRunTask))
    assert set(full) <= {(), ("stiffness-drift",)}  # sets of the same tissue share runs
    assert max(full.values()) <= FEW.checks + FEW.maxima  # each further maximum has a run of its own


def test_where_the_reduced_model_is_exact_a_check_changes_nothing(searched: Searched) -> None:
    _, result = searched(**DRIFT)
    assert all(not fit.correction_n.any() for fit in result.fits.values())
    for fit in result.fits.values():  # no error is allowed for that was not found
        error = fit.fit.log_posterior.model_error
        assert error is not None
        assert error.measured_n is None
        assert len(fit.fit.latent) == 1 + error.columns
    assert result.checks[("sensor-drift",)].off < 1e-9


def test_a_check_in_which_the_full_model_fails_is_told(asked: Make) -> None:
    toy = asked(full=lambda values: "the skin folds", **DRIFT)
    result = toy.search()
    assert result.best.fit.names == ("sensor-drift",)
    assert result.checks[("sensor-drift",)].full_n == "the skin folds"
    assert "sensor-drift: the full model fails at the fit: the skin folds" in toy.told


def test_a_mechanism_that_stood_in_for_others_is_exchanged(searched: Searched) -> None:
    """Each of a set of two is left out in turn, and the others are tried beside the rest."""
    toy, result = searched(**BOTH)
    assert result.best.fit.names == ("force-offset", "stiffness-drift")
    tried = {names_of(task) for task in toy.tasks if isinstance(task, ScoreTestTask)}
    assert ("sensor-drift", "stiffness-drift") in tried
    assert ("force-offset", "sensor-drift") in tried
    rests = {task.names: task for task in toy.tasks if isinstance(task, FitTask) and task.runs == 1}
    assert set(rests) == {("force-offset",), ("stiffness-drift",)}
    for names, rest in rests.items():  # at the tissue of both, not at the one that fits best without one
        own, both = (fit.fit.theta["E_s"] for fit in (result.fits[names], result.best))
        assert abs(rest.start["E_s"] - both) < 0.7 * abs(own - both)


def key(task: Task) -> str:
    return json.dumps([type(task).__name__, asdict(task)], default=np.ndarray.tolist)


@pytest.mark.slow
def test_the_same_seed_gives_the_same_search(asked: Make, searched: Searched) -> None:
    first, result = searched()
    second, other = asked(), asked()
    assert _as_values(second.search(1)) == _as_values(result)
    assert len(first.tasks) == len(second.tasks)
    assert _as_values(other.search(4)) != _as_values(result)


def _as_values(result: SearchResult) -> dict[tuple[str, ...], tuple[float, dict[str, float]]]:
    return {names: (set_fit.fit.value, dict(set_fit.fit.theta)) for names, set_fit in result.fits.items()}


def of_the_drift(task: Task) -> bool:
    return isinstance(task, RunTask) and "stiffness-drift" in task.names


@pytest.mark.parametrize(
    ("lost", "reached"),
    [
        (lambda task: isinstance(task, ScoreTestTask), {"stiffness-drift"}),
        pytest.param(of_the_drift, {"force-offset", "sensor-drift"}, marks=pytest.mark.slow),
        (lambda task: isinstance(task, FitTask | FitWithAddedTask) and bool(names_of(task)), set()),
    ],
    ids=["promises", "probes of a mechanism", "fits with mechanisms"],
)
def test_tasks_that_fail_do_no_more_than_leave_mechanisms_out(
    asked: Make, lost: Callable[[Task], bool], reached: set[str]
) -> None:
    result = asked(**DRIFT, lost=lost).search()
    assert {name for names in result.fits for name in names} == reached
    assert () in result.fits


def test_a_mechanism_whose_probes_fail_in_part_is_still_found(asked: Make) -> None:
    probes: Counter[float] = Counter()

    def lost(task: Task) -> bool:
        """All probes with the first shape that is tried."""
        if not of_the_drift(task):
            return False
        probes[task.theta["stiffness_time"]] += 1
        return task.theta["stiffness_time"] == next(iter(probes))

    toy = asked(stiffness_rate=-9e-4, stiffness_time=200.0, lost=lost)
    assert toy.search().best.fit.names == ("stiffness-drift",)
    assert len(probes) > 1


@pytest.mark.parametrize("share", [1.0, 0.2])
def test_a_mechanism_whose_first_fits_fail_is_fitted_from_where_a_probe_ran_or_a_weaker_one(
    asked: Make, share: float
) -> None:
    ran: list[float] = []

    def lost(task: Task) -> bool:
        """All fits but those that begin at the values of a probe, or nearer to where it does nothing."""
        if of_the_drift(task):
            ran.append(task.theta["stiffness_rate"])
        climbs = isinstance(task, FitTask) and "stiffness-drift" in task.names
        return climbs and not any(task.start["stiffness_rate"] == share * rate for rate in ran)

    result = asked(stiffness_rate=-9e-4, stiffness_time=200.0, lost=lost).search()
    assert result.best.fit.names == ("stiffness-drift",)


@pytest.mark.parametrize(
    ("kind", "says"),
    [
        (RunTask, "runs for no tissue that they allow;"),
        (FitTask, r"runs for no tissue that they allow \(the worker ended\);"),
    ],
)
def test_a_recording_on_which_no_skin_runs_is_refused(asked: Make, kind: type, says: str) -> None:
    toy = asked(lost=lambda task: isinstance(task, kind))
    with pytest.raises(InputError, match=says):
        toy.search()


def test_priors_without_a_skin_that_can_be_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """A subcutis more than twice as stiff as the cutis everywhere."""
    soft, stiff = (replace(p, lower=low, upper=high) for p, low, high in
                   zip(BASE.parameters[:2], (10e3, 200e3), (20e3, 400e3), strict=True))  # fmt: skip
    base = ParameterSpace((soft, stiff, *BASE.parameters[2:]))
    with pytest.raises(InputError, match="priors: the model runs for no tissue"):
        Asked(closed_form_reduced.bench(monkeypatch, closed_form_reduced.recorded(0), base)).search()


@pytest.fixture(scope="module")
def elsewhere() -> tuple[Asked, SearchResult]:
    """A search for further maxima, where the full model is off by more than noise."""
    with pytest.MonkeyPatch.context() as patch:
        recorded = closed_form_reduced.recorded(0, stiffness_rate=9e-4)
        toy = Asked(closed_form_reduced.bench(patch, recorded, full=lambda values: exact(values) + 2e-3))
        return toy, toy.search(settings=FEW)


def test_further_maxima_are_sought_where_the_force_says_little(
    elsewhere: tuple[Asked, SearchResult],
) -> None:
    """Fits set out from layers that drain alike, in exchange, at once or not at all; from other drifts."""
    toy, result = elsewhere
    best = result.best
    assert best.fit.names == ("stiffness-drift",)
    climbs = [task for task in toy.tasks if isinstance(task, FitTask)]
    (first,) = (i for i, task in enumerate(climbs) if task.start["k_c"] == task.start["k_s"])
    tasks = climbs[first : first + 6 + FEW.shapes]
    assert {task.names for task in tasks} == {best.fit.names}
    equal, exchanged, *rest = (task.start for task in tasks)
    ends, shapes = rest[:4], rest[4:]
    drains = [(start["k_c"], start["k_s"]) for start in ends]
    k_c, k_s = (best.fit.theta[name] for name in ("k_c", "k_s"))
    few, many = 10**-15.5, 10**-11.5  # a tenth of the prior from its ends
    expected = [(few, k_s), (k_c, few), (many, k_s), (k_c, many)]
    np.testing.assert_allclose(drains, expected, rtol=0.5)  # they go as one over the stiffness that suits
    assert equal["k_c"] ** 2 == pytest.approx(k_c * k_s, rel=0.5)
    assert (exchanged["k_s"], exchanged["k_c"]) == pytest.approx((k_c, k_s), rel=0.5)
    for start in shapes:
        assert (start["k_c"], start["k_s"]) == pytest.approx((k_c, k_s), rel=0.5)
    times = {start["stiffness_time"] for start in shapes}
    assert len(times - {equal["stiffness_time"], exchanged["stiffness_time"]}) == FEW.shapes


def test_maxima_are_all_distinct_and_the_likeliest_is_the_fit(elsewhere: tuple[Asked, SearchResult]) -> None:
    _, result = elsewhere
    best = result.fits[("stiffness-drift",)]
    space = innermost(best.fit.log_posterior.surrogate).space
    places = [space.to_unit(set_fit.run.theta) for set_fit in (best, *result.others)]
    for i, place in enumerate(places):
        assert all(np.abs(place - other).max() > FEW.alike_by for other in places[:i])
    assert all(weight(set_fit.fit) <= weight(best.fit) for set_fit in result.others)
    assert 0 < len(result.others) <= FEW.maxima


def test_larger_sets_are_fitted_anew_from_a_new_maximum_of_a_part(asked: Make, searched: Searched) -> None:
    toy, (_, result) = asked(**BOTH), searched(**BOTH)
    bench = toy.bench
    part, both = ("stiffness-drift",), ("force-offset", "stiffness-drift")
    assert {part, both} <= set(result.evidences)
    right = result.fits[both]
    worse = replace(right, fit=replace(right.fit, log_evidence=right.fit.log_evidence - 50.0))
    record = SearchRecord({**result.fits, both: worse}, dict(result.checks), dict(result.evidences))
    context = SearchContext(
        toy, bench.binned, bench.base, KNOWN, bench.forward.solves, bench.noise, 1, toy.told.append, QUICK,
        record,
    )  # fmt: skip
    fit_larger_sets(context, result.fits[part])
    assert weight(record.fits[both].fit) > weight(right.fit) - 20.0
    assert both not in record.checks
    Searcher(context).weigh_likely_sets()
    assert record.chosen == both
    assert both in record.checks


def test_what_has_no_name_is_not_imitated_by_ever_larger_sets(asked: Make) -> None:
    """A friction: both force-offset and stiffness-drift gain on it, and together still more."""
    toy = asked(friction_n=8e-3)
    result = toy.search()
    assert result.best.fit.names != ()
    assert result.chosen == ()
    assert result.family.smooth > 0.99
    tried = [task for task in toy.tasks if isinstance(task, RunTask | ScoreTestTask)]
    assert max(len(names_of(task)) for task in tried) == 1
    assert any("with an unnamed smooth discrepancy is as likely" in line for line in toy.told)


def test_the_sets_that_are_compared_are_weighed_at_their_last_fits(searched: Searched) -> None:
    toy, result = searched(more, **BOTH)
    assert result.chosen == ("force-offset", "stiffness-drift")
    weighed = {tuple(task.fit["fit"]["names"]): task.fit["fit"]["value"]
               for task in toy.tasks if isinstance(task, EvidenceTask)}  # fmt: skip
    assert set(weighed) == set(result.evidences)
    assert weighed == {names: result.fits[names].fit.value for names in weighed}
