"""Measures how well several recordings of one skin agree: what each of them loses by sharing the skin.

The chosen set is fitted to each recording alone. If the recordings show the same skin with the same
mechanisms, twice the gain in log-likelihood over the joint fit has a chi-squared distribution with at most as
many degrees of freedom as there are shared parameters (Raveri & Hu 2019, Phys. Rev. D 99:043506, where it is
called the goodness-of-fit loss). Its probability is stated as the distance from zero of a standard normal.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2, norm

from bayeskin.forward.interface import ModelRun
from bayeskin.mismatch.context import DiagnosisContext
from bayeskin.mismatch.search_context import for_task
from bayeskin.mismatch.tasks import AnswerTasks, FitTask
from bayeskin.mismatch.trust_region import SetFit
from bayeskin.types.joint import plain_name, recording_of, values_in

RUNS = 6  # largest number of model runs of a fit to one recording
CONTRADICTS = 3.0  # distance [sd] from which a recording contradicts the others


@dataclass(frozen=True)
class Agreement:
    """The agreement of one recording with the others.

    rms_n : RMS residual [N] of the joint fit in this recording; noise_n : sd [N] of the noise of its bins
    tension : distance [sd] of the loss from zero; None where the recording could not be fitted alone
    """

    name: str
    rms_n: float
    noise_n: float
    tension: float | None

    @property
    def contradicts(self) -> bool:
        """Returns whether the recording contradicts the others."""
        return self.tension is not None and self.tension > CONTRADICTS


def agreements(ask: AnswerTasks, context: DiagnosisContext, joint: SetFit) -> list[Agreement]:
    """Returns the agreement of each of several recordings with a joint fit of a set; [] for one recording."""
    if not context.binned.spans:
        return []
    names, binned = joint.fit.names, context.binned
    tasks = [
        FitTask(
            names, values_in(joint.fit.theta, number), RUNS, for_task(joint.correction_n[bins]), None, number
        )
        for number, bins in enumerate(binned.slices)
    ]
    rows = []
    for number, (answer, bins) in enumerate(zip(ask(tasks), binned.slices, strict=True)):
        residual_n = (binned.force_n - joint.fit.force_n)[bins]
        noise_n = float(np.sqrt(np.nanmean(binned.variance_n2[bins])))
        tension = None if not isinstance(answer, SetFit) else _tension(context, joint, answer, number)
        rows.append(
            Agreement(binned.spans[number].name, float(np.sqrt(np.nanmean(residual_n**2))), noise_n, tension)
        )
    return rows


def _tension(context: DiagnosisContext, joint: SetFit, alone: SetFit, number: int) -> float:
    """Returns the distance [sd] of what a recording loses by the joint fit, compared with its fit alone."""
    own, bins = context.alone[number], context.binned.slices[number]
    space = context.space(joint.fit.names)
    columns = sorted(values_in({name: j for j, name in enumerate(space.names)}, number).values())
    assert joint.run.slopes_n is not None
    run = ModelRun(joint.run.theta[columns], joint.run.force_n[bins], joint.run.slopes_n[bins][:, columns])
    correction_n = joint.correction_n[bins]
    posterior = own.posterior(joint.fit.names, [run], correction_n if correction_n.any() else None)
    theta = posterior.from_sampling(posterior.vector(values_in(joint.fit.theta, number)))
    loss = 2.0 * float(alone.fit.log_likelihood - posterior.log_likelihood(theta)[0])
    shared = sum(plain_name(name) == name for name in space.names) - len(
        {plain_name(name) for name in space.names if recording_of(name)}
    )
    return float(norm.isf(max(chi2.sf(max(loss, 0.0), shared), 1e-300)))
