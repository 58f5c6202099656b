"""Makes data/demo.h5: the full model on a finer mesh than the shipped surrogate's, plus noise.

Run from the repository's root: ``python data/make_demo.py``. What it draws is stated in data/README.md.
"""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
from scipy.signal import lfilter

from bayeskin import storage
from bayeskin.finite_element import ModelSpec, simulate
from bayeskin.types import PadMotion, Recording

TRUTH = {"E_c": 60e3, "E_s": 15e3, "k_c": 2e-14, "k_s": 8e-13, "p_init": 700.0}
CORNERS_S = np.array([0.0, 5.0, 14.4, 45.0, 54.4, 65.0, 74.4, 105.0, 114.4, 130.0])
HEIGHTS_M = 1e-3 * np.array([0.0, 0.0, 9.4, 9.4, 0.0, 0.0, 9.4, 9.4, 0.0, 0.0])
RATE_HZ = 50.0
WHITE_N, SLOW_N, SLOW_S = 4e-3, 4e-3, 0.5  # white noise, and correlated noise with its time
SPIKES_PER_S, SPIKE_N = 0.1, 0.03  # one-sided: always upwards
LVDT_STEP_M = 1e-5
SEED = 20


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
    force_n = simulation.at(time_s) + WHITE_N * rng.standard_normal(n) + slow + spikes
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
