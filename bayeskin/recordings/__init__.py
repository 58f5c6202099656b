"""Reads recordings, finds their phases, measures their noise, averages them in bins, and makes protocols."""

from bayeskin.recordings.bins import BIN_WIDTH_S, bin_recording, covered_s, fitting_width_s, uniform_edges
from bayeskin.recordings.columns import Stated, stated_unit
from bayeskin.recordings.describe import describe, describe_json
from bayeskin.recordings.markers import read_markers
from bayeskin.recordings.motion import idealised_motion, motion_of, recorded_motion
from bayeskin.recordings.noise import PhaseNoise, jumps_of, phase_noise, summarise
from bayeskin.recordings.noise_analysis import NoiseAnalysis, analyse
from bayeskin.recordings.read import ALL, Reading, read_recording, read_tables, shown
from bayeskin.recordings.segment import resolution_m, segment

__all__ = [
    "ALL",
    "BIN_WIDTH_S",
    "NoiseAnalysis",
    "PhaseNoise",
    "Reading",
    "Stated",
    "analyse",
    "bin_recording",
    "covered_s",
    "describe",
    "describe_json",
    "fitting_width_s",
    "idealised_motion",
    "jumps_of",
    "motion_of",
    "phase_noise",
    "read_markers",
    "read_recording",
    "read_tables",
    "recorded_motion",
    "resolution_m",
    "segment",
    "shown",
    "stated_unit",
    "summarise",
    "uniform_edges",
]
