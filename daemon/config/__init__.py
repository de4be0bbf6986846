"""The configuration: one TOML file, validated whole before anything starts."""

from daemon.config.config import Config, DeviceEntry
from daemon.config.loading import load_config, parse_config
from daemon.config.tables import (
    AtmosphereConfig,
    AttitudeConfig,
    GeometryConfig,
    GimbalConfig,
    GimbalStage,
    GnssConfig,
    GnssSetupConfig,
    ImuConfig,
    MtaConfig,
    NoiseConfig,
    OutputConfig,
    PpsConfig,
    ProfileConfig,
    ScannerConfig,
    SessionConfig,
    SignalsConfig,
    Tables,
)

__all__ = [
    "AtmosphereConfig",
    "AttitudeConfig",
    "Config",
    "DeviceEntry",
    "GeometryConfig",
    "GimbalConfig",
    "GimbalStage",
    "GnssConfig",
    "GnssSetupConfig",
    "ImuConfig",
    "MtaConfig",
    "NoiseConfig",
    "OutputConfig",
    "PpsConfig",
    "ProfileConfig",
    "ScannerConfig",
    "SessionConfig",
    "SignalsConfig",
    "Tables",
    "load_config",
    "parse_config",
]
