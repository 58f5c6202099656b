"""Makes data/demo.h5: the full model on a finer mesh than the inference uses, concealed friction, and noise.

Run from the repository's root: ``python data/make_demo.py``. What it draws is stated in data/README.md.

The slide that carries the pads has dry friction. Its law is not the one that `bayeskin diagnose` knows, where
friction approaches its limit exponentially (Dahl). It is a Coulomb slider behind a linear spring: friction
grows linearly with the travel, and then stays at its limit.
Source: W. Iwan, A distributed-element model for hysteresis, J. Appl. Mech. 33 (1966), 893-900.
"""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
from scipy.signal import lfilter

from bayeskin import storage
from bayeskin.finite_element import ModelSpec, simulate
from bayeskin.types import Array, PadMotion, Recording

TRUTH = {"E_c": 60e3, "E_s": 15e3, "k_c": 2e-14, "k_s": 8e-13, "p_init": 700.0}
CORNERS_S = np.array([0.0, 5.0, 14.0, 40.0, 49.0, 60.0])
HEIGHTS_M = 1e-3 * np.array([0.0, 0.0, 9.0, 9.0, 0.0, 0.0])
RATE_HZ = 50.0
FRICTION_N, PRESLIDING_M = 0.04, 1.5e-4  # limit of the friction, and travel after which it slides
WHITE_N, SLOW_N, SLOW_S = 4e-3, 4e-3, 0.5  # white noise, and correlated noise with its time
SPIKES_PER_S, SPIKE_N = 0.1, 0.03  # one-sided: always upwards
LVDT_STEP_M = 1e-5
SEED = 20


def friction(displacement_m: Array) -> Array:
    """Returns the force [N] of the Coulomb slider behind its spring, which is at rest and relaxed at first.

    displacement_m (n,) : displacement of the slide, in steps that are short beside the presliding length
    """
    force_n = np.zeros(len(displacement_m))
    for i, step_m in enumerate(np.diff(displacement_m)):
        trial_n = force_n[i] + FRICTION_N * step_m / PRESLIDING_M
        force_n[i + 1] = np.clip(trial_n, -FRICTION_N, FRICTION_N)
    return force_n


def main() -> None:
    motion = PadMotion(CORNERS_S, HEIGHTS_M)
    simulation = simulate(ModelSpec(refinement=2), motion, TRUTH)
    if simulation.status != "ok":
        raise SystemExit(simulation.message)
    rng = np.random.default_rng(SEED)
    time_s = np.arange(0.0, CORNERS_S[-1] + 0.5 / RATE_HZ, 1.0 / RATE_HZ)
    n = len(time_s)
    keep = np.exp(-1.0 / (RATE_HZ * SLOW_S))
    slow = SLOW_N * np.sqrt(1 - keep**2) * lfilter([1.0], [1.0, -keep], rng.standard_normal(n))
    spikes = SPIKE_N * rng.exponential(size=n) * (rng.random(n) < SPIKES_PER_S / RATE_HZ)
    measured_n = simulation.at(time_s) + friction(motion.at(time_s))
    force_n = measured_n + WHITE_N * rng.standard_normal(n) + slow + spikes
    recording = Recording(
        time_s=time_s,
        displacement_m=LVDT_STEP_M * np.round(motion.at(time_s) / LVDT_STEP_M),
        force_n=np.round(force_n, 4),
        name="demo",
        sha256=hashlib.sha256(Path(__file__).read_bytes()).hexdigest(),
        notes=("simulated by data/make_demo.py, not measured",),
    )
    storage.save(Path(__file__).with_name("demo.h5"), recording)
    print(f"peak {force_n.max():.3f} N, {simulation.stats['seconds']:.0f} s, data/demo.h5 written")


if __name__ == "__main__":
    main()
