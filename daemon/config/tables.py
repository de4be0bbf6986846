"""Defines every key of the configuration: its type, unit (in the name), bounds and default.

The models are strict: an unknown key is an error, and text is never converted to a number. docs/configuration.md prints
the descriptions.
"""

from __future__ import annotations

import datetime as dt
from typing import Annotated, Any, Literal, Self

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator

from swath.daemon.config.listen import listen_text
from swath.daemon.config.rotations import angles_of_prisms, with_matrix, within_a_turn

NAME_PATTERN = r"^[A-Za-z0-9_-]+$"
SIGNAL_PATTERN = r"^[A-Za-z_][A-Za-z0-9_]*\.[A-Za-z_][A-Za-z0-9_]*$"

Name = Annotated[str, Field(pattern=NAME_PATTERN, max_length=64)]
Text = Annotated[str, Field(min_length=1)]
Signal = Annotated[str, Field(pattern=SIGNAL_PATTERN)]
Vector = Annotated[list[float], Field(min_length=3, max_length=3)]

Angles = Annotated[list[float], Field(min_length=3, max_length=3), AfterValidator(within_a_turn)]
Wedges = Annotated[list[float], Field(min_length=2, max_length=2), AfterValidator(angles_of_prisms)]
Matrix = Annotated[list[Vector], Field(min_length=3, max_length=3)]
SignalTriple = Annotated[list[Signal], Field(min_length=3, max_length=3)]


def _zero_vector() -> list[float]:
    return [0.0, 0.0, 0.0]


def _identity() -> list[list[float]]:
    return [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]


class Section(BaseModel):
    """A table of the configuration file."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)


class SessionConfig(Section):
    """``[session]``: name, directory and writing of the logs."""

    name: Name = Field(description="a name, the first part of every log's name")
    directory: Text = Field("/var/lib/swath", description="folder for the logs; relative to this file")
    compression: Literal["auto", "lz4", "zstd", "none"] = Field(
        "auto", description="compression of chunks; auto: none for scanners, lz4 for the rest"
    )
    split_size_mb: float = Field(2048.0, ge=1.0, le=1_000_000.0, description="size at which a new part begins")
    split_minutes: float = Field(30.0, ge=0.01, le=1440.0, description="duration after which a new part begins")
    fsync_s: float = Field(
        1.0, ge=0.05, le=60.0, description="interval of forced writes to the disk; never more than one second"
    )
    reserve_mb: float = Field(
        512.0, ge=1.0, le=10_000_000.0, description="free space below which recording stops cleanly; it resumes above"
    )


class PpsConfig(Section):
    """``[pps.<name>]``: a source of one edge per second."""

    source: Text = Field(description="/dev/ppsN, serial-dcd:/dev/ttyS0 or fixed:<path>")
    edge: Literal["assert", "clear"] = Field("assert", description="edge that marks the second")
    delay_ns: int = Field(
        0,
        ge=-500_000_000,
        le=500_000_000,
        description="cable and capture delay, which is subtracted from the time stamp",
    )


class GnssSetupConfig(Section):
    """``[gnss.<name>.setup]``: the settings that `swath setup` sends to a receiver."""

    port: Text | None = Field(
        None,
        description="the receiver's name for the port that is wired to this computer: "
        "ubx: UART1, UART2, USB (absent: UART1); sbf: COM1 to COM4, USB1, USB2, "
        "over TCP IP10 to IP17, IPS1 to IPS5 (absent: COM1)",
    )
    rate_hz: Literal[1, 2, 5, 10, 20] = Field(5, description="rate of positions and velocities")
    raw: bool = Field(True, description="send raw measurements and ephemerides too, for post-processing")


class GnssConfig(Section):
    """``[gnss.<name>]``: a GNSS receiver."""

    transport: Text = Field(description="serial:…, udp:…, tcp:…, or imu:<name> (inside its stream)")
    protocol: Text = Field(description="nmea, ubx, novatel, … (`swath devices` lists them)")
    pps: Name | None = Field(None, description="name of the [pps.<name>] wired to this receiver")
    names_edge: Literal["auto", "previous", "next"] = Field(
        "auto", description="the edge that a time message refers to; auto: according to the protocol"
    )
    lever_arm_m: Vector = Field(default_factory=_zero_vector, description="antenna's phase centre from the body, x_a^b")
    secondary_lever_arm_m: Vector | None = Field(
        None, description="second antenna from the body, for dual-antenna heading"
    )
    leap_seconds: int | None = Field(
        None,
        ge=0,
        le=60,
        description="GPS − UTC for NMEA, used until the receiver sends it; absent: built-in table, by date",
    )
    date_floor: dt.date | None = Field(
        None,
        description="oldest accepted date, which resolves ten-bit week numbers; absent: 2009-01-01",
    )
    add_weeks: int = Field(
        0,
        ge=0,
        le=3072,
        multiple_of=1024,
        description="weeks added to its dates: 1024 for each week roll-over that the firmware misses",
    )
    datum: str | None = Field(
        None,
        min_length=1,
        description='datum realisation of its positions, such as "EPSG:7912"; absent: WGS 84, realisation unknown; '
        '"same": as the output',
    )
    setup: GnssSetupConfig = Field(
        default_factory=GnssSetupConfig, description="settings that `swath setup` sends to it"
    )
    options: dict[str, Any] = Field(
        default_factory=dict, description="keys of the driver's own, where it comes from another package"
    )


class SignalsConfig(Section):
    """``[imu.<name>.signals]``: the signals of the DBC for each quantity, as ``MESSAGE.signal``."""

    specific_force: SignalTriple | None = Field(None, description="three signals: x, y, z in the axes of the IMU")
    angular_rate: SignalTriple | None = Field(None, description="three signals: x, y, z in the axes of the IMU")
    sample_ticks: Signal | None = Field(None, description="the device's counter at the time of the sample")
    pps_ticks: Signal | None = Field(None, description="the counter latched at the last PPS edge")
    temperature: Signal | None = Field(None, description="°C")
    status: Signal | None = Field(None, description="the device's status word, stored with each sample")
    packet_counter: Signal | None = Field(
        None, description="counter of the samples sent; skipped numbers are counted as losses"
    )


class NoiseConfig(Section):
    """``[imu.<name>.noise]``: noise model of the navigation filter; single keys override the grade."""

    grade: Literal["navigation", "tactical", "mems", "consumer"] = Field(
        "tactical", description="class that gives the values absent below"
    )
    angle_random_walk_deg_per_sqrt_h: float | None = Field(None, ge=0.0, le=100.0, description="default: the grade's")
    velocity_random_walk_m_per_s_per_sqrt_h: float | None = Field(
        None, ge=0.0, le=100.0, description="default: the grade's"
    )
    gyro_bias_deg_per_h: float | None = Field(None, ge=0.0, le=100_000.0, description="default: the grade's")
    accel_bias_mg: float | None = Field(None, ge=0.0, le=1_000.0, description="default: the grade's")
    bias_correlation_h: float | None = Field(None, gt=0.0, le=10_000.0, description="default: the grade's")
    gyro_scale_ppm: float | None = Field(None, ge=0.0, le=100_000.0, description="default: the grade's")
    accel_scale_ppm: float | None = Field(None, ge=0.0, le=100_000.0, description="default: the grade's")
    misalignment_mrad: float | None = Field(
        None, ge=0.0, le=100.0, description="misalignment between the axes; default: the grade's; 0: not estimated"
    )


class ImuConfig(Section):
    """``[imu.<name>]``: an inertial measurement unit."""

    transport: Text = Field(
        description="can:<interface>:<channel>?…, serial:…, udp:…, tcp:…, or gnss:<name>, scanner:<name> (inside "
        "its stream)"
    )
    protocol: Text = Field(description="dbc, or a named profile (`swath devices` lists them)")
    dbc: Text | None = Field(None, description="the DBC file, relative to this file")
    imu_type: Text | None = Field(
        None, description="novatel: IMU type as in INSCONFIG (HG1900_CA50), needed if the stream does not name it"
    )
    source_address: int | None = Field(
        None,
        ge=0,
        le=253,
        description="nmea2000, dbc of J1939: address of the device to use; absent: the first device that sends the "
        "PGN; dbc: of the messages with one address in the DBC, the first that sends any",
    )
    ids: dict[str, int] | None = Field(
        None, description="sbg-ellipse, xsens-mti: CAN identifiers, by message name, where they differ from the maker's"
    )
    extended_ids: bool = Field(False, description="sbg-ellipse, xsens-mti: identifiers have 29 bits")
    byte_order: Literal["big", "little"] = Field(
        "big", description="xsens-mti: byte order of the numbers in a CAN frame"
    )
    pps_event: Literal["A", "B", "C", "D", "E"] | None = Field(
        None,
        description="sbg-ellipse, sbg-ecom: the Sync In that PPS is wired to; its event holds the latched counter",
    )
    altitude: Literal["geoid", "ellipsoid"] | None = Field(
        None,
        description="oxts-ncom, nmea2000: what the device's altitude counts from, by its own configuration; absent: "
        "geoid for oxts-ncom, fixes without a height for nmea2000",
    )
    solution_of: Literal["vehicle", "sensor1", "sensor2"] = Field(
        "vehicle", description="applanix-pos: the point whose navigation is the solution"
    )
    acceleration_unit: Literal["m/s2", "g"] = Field(
        "m/s2", description="records: unit of its accelerations; some drivers of ROS (Livox) send g"
    )
    rate_hz: float = Field(200.0, gt=0.0, le=100_000.0, description="nominal sample rate")
    rotation_b_imu: Matrix = Field(
        default_factory=_identity,
        description="rotation from the IMU's axes to the body, by rows; also applied to the attitude of its INS",
    )
    rotation_b_imu_deg: Angles | None = Field(
        None, description="instead of the matrix: its roll, pitch, yaw; see Angles of a mounting"
    )
    tick_hz: float | None = Field(
        None,
        gt=0.0,
        le=1e12,
        description="rate of its counters, which wrap at their signals' width; absent: 1000000; required for xsens-mti",
    )
    pps: Name | None = Field(None, description="name of the [pps.<name>] that latches its counter")
    sample: Literal["mean", "instant", "increment"] = Field(
        "mean",
        description="meaning of a sample: mean over the interval, instant value, or increment (of velocity and angle)",
    )
    stamp: Literal["end", "middle", "start"] = Field(
        "end", description="the point of the interval that the time stamp refers to"
    )
    group: Literal["last", "first"] | None = Field(
        None,
        description="whether the message with sample_ticks is the last or the first one of a sample; "
        "absent: for dbc, found from the spacing of the frames",
    )
    signals: SignalsConfig | None = Field(None, description="signals of the DBC file, by quantity")
    units: dict[Signal, Text] | None = Field(
        None, description='dbc: units that the DBC does not give, by signal, such as { "ACC.x" = "g" }'
    )
    noise: NoiseConfig = Field(default_factory=NoiseConfig, description="noise model for the navigation filter")
    options: dict[str, Any] = Field(
        default_factory=dict, description="keys of the driver's own, where it comes from another package"
    )

    @model_validator(mode="before")
    @classmethod
    def _fill_rotation(cls, table: Any) -> Any:
        return with_matrix(table, "rotation_b_imu", "rotation_b_imu_deg")


_KEYS_OF_GEOMETRY = {
    "polygon": ("facets",),
    "nutating": ("nutation_deg", "shaft_angle_deg"),
    "risley": ("wedge_deg", "refractive_index", "prism_ratio"),
}


class GeometryConfig(Section):
    """``[scanner.<name>.geometry]``: how the beam is deflected."""

    type: Literal["oscillating", "polygon", "monogon", "nutating", "fibre", "risley"] | None = Field(
        None, description="srep: how the beam is deflected"
    )
    facets: int | None = Field(None, ge=2, le=256, description="polygon: number of facets")
    nutation_deg: float | None = Field(
        None, gt=0.0, le=20.0, description="nutating: angle between the mirror's normal and its shaft"
    )
    shaft_angle_deg: float | None = Field(
        None, gt=0.0, lt=90.0, description="nutating: angle between the mirror's shaft and the laser's beam"
    )
    wedge_deg: Wedges | None = Field(None, description="risley: wedge angles of the two prisms")
    refractive_index: float | None = Field(None, gt=1.0, le=4.0, description="risley: refractive index of both prisms")
    prism_ratio: float | None = Field(
        None,
        description="risley: turns of the second prism per turn of the first, which the encoder counts",
    )
    file: Text | None = Field(
        None, description="the head's own file (beam angles; ouster: metadata as JSON), relative to this file"
    )

    @model_validator(mode="after")
    def _keys_are_of_the_type(self) -> Self:
        if self.type == "polygon" and self.facets is None:
            raise ValueError('type = "polygon" needs facets = <number of facets>')
        for kind, keys in _KEYS_OF_GEOMETRY.items():
            given = [key for key in keys if getattr(self, key) is not None]
            if given and self.type != kind:
                raise ValueError(f'{given[0]} belongs to type = "{kind}" only')
            if given and len(given) < len(keys):
                raise ValueError(f'type = "{kind}" needs all of {", ".join(keys)} or none')
        return self


class GimbalStage(Section):
    """One stage of a gimbal, outermost first (FORMULAS 2.1, NGA Eq. 3)."""

    angles_deg: Angles = Field(default_factory=_zero_vector, description="fixed roll, pitch, yaw of the stage")
    lever_arm_m: Vector = Field(
        default_factory=_zero_vector, description="from this stage's centre to the next inner one"
    )
    source: str | None = Field(
        None, pattern=r"^(gnss|imu|scanner)/[A-Za-z0-9_-]+$", description="logged source of its angles"
    )


class GimbalConfig(Section):
    """``[scanner.<name>.gimbal]``: a stabilised or pointed mount."""

    stages: list[GimbalStage] = Field(
        default_factory=list, max_length=4, description="up to 4 stages, outermost first; empty: a rigid mount"
    )


class ScannerConfig(Section):
    """``[scanner.<name>]``: a laser scanner."""

    transport: Text = Field(description="udp:<address>:<port>?group=…&source=…")
    auxiliary: Text | None = Field(None, description="transport of the same head's position, IMU or GPS packets")
    protocol: Text = Field(description="srep, velodyne-vlp16, … (`swath devices` lists them)")
    pps: Name | None = Field(None, description="name of the [pps.<name>] wired to this head")
    clock: Literal["auto", "ptp-tai", "ptp-utc", "utc-hour", "free"] = Field(
        "auto",
        description="origin of its time stamps, if the data do not tell: 1970 in TAI or UTC (PTP), the hour of UTC "
        "(Velodyne, locked), its own start (free); auto: found from their arrival times",
    )
    model: str = Field("", description="maker's type; a calibration of another type is refused")
    serial: str = Field("", description="serial number; a calibration of another head is refused")
    mirror_factor: float | None = Field(
        None, ge=-4.0, le=4.0, description="beam angle per encoder angle; required for srep (2 flat mirror, 1 monogon)"
    )
    installation: Matrix | None = Field(
        None, description="rotation T from scanner to body axes, by rows; required for spinning heads, else identity"
    )
    installation_deg: Angles | None = Field(
        None, description="instead of the matrix: its roll, pitch, yaw; see Angles of a mounting"
    )
    calibration: Text | None = Field(None, description="calibration file, relative to this file")
    lever_arm_m: Vector = Field(
        default_factory=_zero_vector,
        description="scanner's position from the body, x_s^b, if no calibration file gives it",
    )
    range_min_m: float = Field(
        0.0, ge=0.0, le=100_000.0, description="shortest range; nearer returns are left out of products"
    )
    range_max_m: float = Field(
        10_000.0, gt=0.0, le=100_000.0, description="longest range; farther returns are left out of products"
    )
    range_sigma_m: float = Field(0.02, ge=0.0, le=100.0, description="standard deviation of a range")
    angle_sigma_deg: float = Field(
        0.001, ge=0.0, le=10.0, description="standard deviation of the beam's direction along the scan"
    )
    divergence_mrad: float = Field(0.3, ge=0.0, le=100.0, description="full divergence of the beam, its wider axis")
    wavelength_nm: float | None = Field(
        None, ge=300.0, le=2000.0, description="wavelength of the laser; absent: the maker's, or 1064 if unknown"
    )
    geometry: GeometryConfig | None = Field(None, description="how the beam is deflected")
    gimbal: GimbalConfig | None = Field(None, description="stages of a stabilised or pointed mount")
    options: dict[str, Any] = Field(
        default_factory=dict, description="keys of the driver's own, where it comes from another package"
    )

    @model_validator(mode="before")
    @classmethod
    def _fill_installation(cls, table: Any) -> Any:
        return with_matrix(table, "installation", "installation_deg")

    @model_validator(mode="after")
    def _ranges(self) -> Self:
        if self.range_min_m >= self.range_max_m:
            raise ValueError(f"range_min_m {self.range_min_m:g} is not below range_max_m {self.range_max_m:g}")
        if self.mirror_factor == 0.0:
            raise ValueError("mirror_factor is 0; want 2 for a flat mirror turned in its plane, 1 for a 45° mirror")
        return self


class CorrectionsConfig(Section):
    """``[corrections.<name>]``: corrections of a base station, which are logged and can be passed on to a receiver."""

    transport: Text = Field(description="serial:…, udp:…, tcp:… or ntrip:<host>:<port>/<mountpoint>?…")
    protocol: Text = Field("rtcm3", description="rtcm3")
    forward_to: Text | None = Field(
        None, description="receiver whose serial or TCP port gets the bytes, such as gnss.rover"
    )
    options: dict[str, Any] = Field(
        default_factory=dict, description="keys of the driver's own, where it comes from another package"
    )


class RawConfig(Section):
    """``[raw.<name>]``: any device that no driver reads yet, recorded as it comes."""

    transport: Text = Field(description="serial:…, udp:…, tcp:…, can:… or ntrip:…")
    protocol: Literal["raw"] = Field("raw", description="raw")


class AttitudeConfig(Section):
    """``[attitude]``: the vertical that the attitude refers to."""

    vertical: Literal["ellipsoid", "plumb"] = Field(
        "ellipsoid", description="reference of the attitude; plumb needs the two keys below"
    )
    xi_arcsec: float | None = Field(
        None, ge=-120.0, le=120.0, description="deflection of the vertical ξ, north, astronomic − geodetic"
    )
    eta_arcsec: float | None = Field(
        None, ge=-120.0, le=120.0, description="deflection of the vertical η, east, astronomic − geodetic"
    )

    @model_validator(mode="after")
    def _plumb_has_deflection(self) -> Self:
        given = [key for key in ("xi_arcsec", "eta_arcsec") if getattr(self, key) is not None]
        if self.vertical == "plumb" and len(given) < 2:
            raise ValueError('vertical = "plumb" needs xi_arcsec and eta_arcsec')
        if self.vertical == "ellipsoid" and given:
            raise ValueError(f'{given[0]} belongs to vertical = "plumb" only')
        return self


class AtmosphereConfig(Section):
    """``[atmosphere]``: the air between the scanner and the ground."""

    ranges: Literal["corrected", "vacuum"] = Field(
        "corrected",
        description="corrected: the device corrects its ranges; vacuum: they are corrected with the model below",
    )
    model: Literal["standard", "measured"] = Field(
        "standard", description="standard: standard atmosphere; measured: the values below"
    )
    temperature_c: float = Field(15.0, ge=-80.0, le=60.0, description="air temperature at height_m, for measured")
    pressure_hpa: float = Field(1013.25, ge=100.0, le=1100.0, description="air pressure at height_m, for measured")
    humidity_percent: float = Field(50.0, ge=0.0, le=100.0, description="relative humidity at height_m, for measured")
    height_m: float = Field(0.0, ge=-500.0, le=12_000.0, description="height of the measurement")
    refraction: Literal["none", "ardc", "spherical"] = Field("none", description="model of the bending of the beam")


class MtaConfig(Section):
    """``[mta]``: several pulses in the air at the same time."""

    terrain: str = Field(
        "", description="coarse terrain model, GeoTIFF of ellipsoidal heights; empty: zones follow by continuity"
    )
    height_above_ground_m: float | None = Field(
        None,
        gt=0.0,
        le=12_000.0,
        description="usual flying height, for the first zone where terrain is empty; zone 255 needs one of the two",
    )


class ProfileConfig(Section):
    """``[profile]``: names of aircraft, installation and operator for the records and pages."""

    aircraft: str = Field("", description="name of the aircraft")
    operator: str = Field("", description="who flies or delivers: the author that pages and PDF name")
    installation: str = Field("", description="identifier of this mounting")


class OutputConfig(Section):
    """``[output]``: the mapping frame."""

    crs: str | None = Field(
        None, min_length=1, description="any CRS known to PROJ; if two-dimensional, heights are ellipsoidal"
    )
    epoch: float | None = Field(
        None, ge=1900.0, le=2200.0, description="epoch of the coordinates (year), for dynamic datums"
    )
    datum_accuracy_m: float = Field(
        0.05, gt=0.0, le=10.0, description="accuracy required of a change of datum; less accurate ones are refused"
    )


class WantedConfig(Section):
    """``[calibration.wanted]``: the standard deviations that a calibration has to reach."""

    point_m: float | None = Field(None, gt=0.0, le=100.0, description="remaining error of a point, over all three axes")
    omega_deg: float | None = Field(None, gt=0.0, le=10.0, description="boresight ω")
    phi_deg: float | None = Field(None, gt=0.0, le=10.0, description="boresight φ")
    kappa_deg: float | None = Field(None, gt=0.0, le=10.0, description="boresight κ")
    range_offset_m: float | None = Field(None, gt=0.0, le=100.0, description="range offset")
    range_scale_ppm: float | None = Field(None, gt=0.0, le=1e6, description="range scale")
    scan_angle_scale_ppm: float | None = Field(None, gt=0.0, le=1e6, description="scan angle scale")
    scan_plane_tilt_deg: float | None = Field(None, gt=0.0, le=10.0, description="scan plane tilt")
    time_offset_us: float | None = Field(None, gt=0.0, le=1e6, description="time offset")


class CalibrationConfig(Section):
    """``[calibration]``: the criteria by which `swath calibrate` judges a calibration."""

    wanted: WantedConfig = Field(default_factory=WantedConfig, description="standard deviations to reach")


class PlanToleranceConfig(Section):
    """``[plan.tolerance]``: how far a line may be flown from its plan before it gets a remark."""

    cross_track_m: float = Field(20.0, gt=0.0, le=10_000.0, description="distance to either side of the line")
    height_m: float = Field(30.0, gt=0.0, le=5_000.0, description="difference from the wanted height")
    speed_mps: float = Field(5.0, gt=0.0, le=100.0, description="difference from the wanted speed")
    bank_deg: float = Field(10.0, gt=0.0, le=60.0, description="bank while the laser measures")


class PlanWantedConfig(Section):
    """``[plan.wanted]``: what every line has to reach."""

    speed_mps: float | None = Field(
        None, gt=0.0, le=300.0, description="speed over the ground, if the plan gives none for the line"
    )
    height_above_ground_m: float | None = Field(
        None, gt=0.0, le=12_000.0, description="height above ground, if the plan gives no height for the line"
    )
    density_per_m2: float | None = Field(
        None, gt=0.0, le=100_000.0, description="first returns on a square metre of the swath"
    )
    overlap_percent: float | None = Field(
        None, ge=0.0, lt=100.0, description="overlap with the neighbouring line's swath, of the narrower of the two"
    )
    fix: Literal["auto", "any", "float", "fixed"] = Field(
        "auto", description="least quality of the receivers' positions; auto: fixed as soon as one was, before that any"
    )
    quality_level: Literal["QL0", "QL1", "QL2", "QL3"] | None = Field(
        None, description="USGS quality level whose RMSDz overlapping strips have to keep; shown, no line's verdict"
    )
    gap_m2: float = Field(100.0, gt=0.0, le=1e6, description="smallest gap in the area that is reported")
    static_s: float = Field(60.0, ge=0.0, le=3600.0, description="standing still before take-off and after landing")


class PlanConfig(Section):
    """``[plan]``: the flight plan, against which `swath live` judges the lines as they are flown."""

    file: Text | None = Field(
        None,
        description="lines, and possibly the area: KML, KMZ, GeoJSON, GeoPackage, shapefile or a plan of swath sim, "
        "relative to this file",
    )
    layer: Text | None = Field(None, description="layer of a GeoPackage; absent: all of them")
    names: Text | None = Field(
        None, description="attribute that names the lines; absent: the first usual one, such as name, line or id"
    )
    crs: str | None = Field(None, min_length=1, description="CRS of the file's coordinates, if it gives none")
    heights: Literal["auto", "ellipsoid", "geoid", "ground", "none"] = Field(
        "auto", description="what its heights count from; none: they are not used; auto: as the format says"
    )
    undulation_m: float | None = Field(
        None, ge=-120.0, le=120.0, description="the geoid's height above the ellipsoid, for heights above sea level"
    )
    area: Text | None = Field(None, description="file of the polygons to be covered; absent: those of the plan's file")
    tolerance: PlanToleranceConfig = Field(
        default_factory=PlanToleranceConfig, description="limits of a line without remarks"
    )
    wanted: PlanWantedConfig = Field(default_factory=PlanWantedConfig, description="what every line has to reach")


class LiveConfig(Section):
    """``[live]``: size and density of the files that `swath live` writes beside the log."""

    live_quota_mb: float = Field(
        4096.0, ge=1.0, le=10_000_000.0, description="disk space for live.mcap, including its predecessor"
    )
    points_per_s: int = Field(
        100_000, ge=1, le=100_000, description="points written to live.mcap for display; grids use all points"
    )
    cell_m: float = Field(
        2.0, ge=0.05, le=1000.0, description="cell size of the map; doubled when the area is too large"
    )


class ConsoleConfig(Section):
    """``[console]``: the operator's pages, served by `swath console`."""

    listen: Annotated[str, AfterValidator(listen_text)] = Field(
        "127.0.0.1:8470",
        description="address and port; beyond this computer (not 127.0.0.1 or [::1]) tokens and TLS are needed",
    )
    names: list[str] = Field(
        default_factory=list, max_length=16, description="further names by which tablets call this computer"
    )
    marks: list[Annotated[str, Field(min_length=1, max_length=80)]] = Field(
        default_factory=list, max_length=8, description="texts of the marks of the keys F1 to F8"
    )
    background: Text | None = Field(None, description="map behind the painted one: MBTiles, PMTiles or GeoTIFF")


class Tables(Section):
    """The whole configuration file."""

    session: SessionConfig
    pps: dict[Name, PpsConfig] = Field(default_factory=dict)
    gnss: dict[Name, GnssConfig] = Field(default_factory=dict)
    imu: dict[Name, ImuConfig] = Field(default_factory=dict)
    scanner: dict[Name, ScannerConfig] = Field(default_factory=dict)
    corrections: dict[Name, CorrectionsConfig] = Field(default_factory=dict)
    raw: dict[Name, RawConfig] = Field(default_factory=dict)
    attitude: AttitudeConfig = Field(default_factory=AttitudeConfig)
    atmosphere: AtmosphereConfig = Field(default_factory=AtmosphereConfig)
    mta: MtaConfig = Field(default_factory=MtaConfig)
    profile: ProfileConfig = Field(default_factory=ProfileConfig)
    output: OutputConfig = Field(default_factory=OutputConfig)
    calibration: CalibrationConfig = Field(default_factory=CalibrationConfig)
    plan: PlanConfig = Field(default_factory=PlanConfig)
    live: LiveConfig = Field(default_factory=LiveConfig)
    console: ConsoleConfig = Field(default_factory=ConsoleConfig)
