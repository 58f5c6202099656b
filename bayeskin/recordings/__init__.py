"""Recordings: read, cut into phases, their noise measured, binned, and turned into protocols."""

from bayeskin.recordings.bins import bin_recording, uniform_edges
from bayeskin.recordings.describe import describe, describe_json
from bayeskin.recordings.motion import idealised_motion, motion_of, recorded_motion
from bayeskin.recordings.noise import NoiseAnalysis, PhaseNoise, analyse, phase_noise, summarise
from bayeskin.recordings.read import read_recording
from bayeskin.recordings.segment import resolution_m, segment

__all__ = [
    "NoiseAnalysis",
    "PhaseNoise",
    "analyse",
    "bin_recording",
    "describe",
    "describe_json",
    "idealised_motion",
    "motion_of",
    "phase_noise",
    "read_recording",
    "recorded_motion",
    "resolution_m",
    "segment",
    "summarise",
    "uniform_edges",
]
