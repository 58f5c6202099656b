"""Reads and checks the configuration of a run; reports an error in one line that names the key."""

from bayeskin.config.configuration import WHO_RUNS, Config
from bayeskin.config.files import config_of, load_config, to_toml
from bayeskin.config.priors import parameter_space
from bayeskin.config.run_sections import FEWEST_CHECKED, DesignConfig, RecordingConfig
from bayeskin.config.study import StudyFile, load_study

__all__ = [
    "FEWEST_CHECKED",
    "WHO_RUNS",
    "Config",
    "DesignConfig",
    "RecordingConfig",
    "StudyFile",
    "config_of",
    "load_config",
    "load_study",
    "parameter_space",
    "to_toml",
]
