"""Every key of a plan with its type, unit (in the name), bounds and default; names are those of the configuration.

Positions on the ground are metres east and north of the origin, in the plane that touches the ellipsoid there (the site
frame of `swath.sim.site`). Heights are ellipsoidal.
"""

from __future__ import annotations

import datetime as dt
from typing import Literal

from pydantic import Field

from swath.sim.plan.base import Matrix, Name, NotNegative, Point, Positive, Section, Vector, Wired
from swath.sim.plan.terrain_tables import TerrainTable


def _identity() -> list[list[float]]:
    return [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]


# ---------------------------------------------------------------------------------------------- flight


class FlightTable(Section):
    """``[flight]``: place, start time and manner of the flight."""

    name: Name = Field(description="first part of the log's name")
    seed: int = Field(1, ge=0, lt=2**63, description="the same seed gives the same bytes")
    start: dt.datetime = Field(
        default=dt.datetime(2026, 6, 15, 9, 0, 0, tzinfo=dt.UTC),
        description="beginning of the recording, with its UTC offset",
    )
    origin_deg: Point = Field(default_factory=lambda: [47.5, 8.9], description="latitude, longitude of the site")
    crs: str = Field("EPSG:32632", min_length=1, description="CRS of the products, for the written configuration")
    speed_mps: float = Field(60.0, ge=10.0, le=150.0, description="speed over the ground of lines without their own")
    bank_max_deg: float = Field(25.0, ge=5.0, le=60.0, description="greatest bank in turns")
    turn_radius_m: float | None = Field(
        None, gt=0.0, description="radius of turns; absent: the least that the bank allows"
    )
    climb_max_mps: float = Field(5.0, ge=0.5, le=30.0, description="greatest climb and descent between lines")
    pitch_deg: float = Field(2.0, ge=-10.0, le=15.0, description="angle of the nose above the path in level flight")
    wind_mps: Point = Field(
        default_factory=lambda: [0.0, 0.0], description="velocity of the air towards east and north"
    )
    turbulence: Literal["none", "light", "moderate", "severe"] = Field("light", description="strength of turbulence")
    noise: bool = Field(True, description="false: all sensors without noise, biases and jitter; counts stay whole")
    lead_s: float = Field(4.0, ge=0.0, le=60.0, description="straight and level flight before and behind each line")


class GroundStart(Section):
    """``[ground]``: a start on the ground; without this table the flight begins in the air, on the way to the first
    line.
    """

    runway_m: Point = Field(description="east, north of the start of the take-off run")
    heading_deg: float = Field(0.0, ge=0.0, le=360.0, description="heading of the runway")
    height_m: float | None = Field(None, description="height of the runway; absent: that of the terrain")
    static_s: float = Field(120.0, ge=0.0, le=3600.0, description="time of standing with running engine, for alignment")
    taxi_m: float = Field(
        200.0, ge=0.0, le=5000.0, description="distance taxied along the runway's heading before the take-off run"
    )


class LineTable(Section):
    """``[[line]]``: a flight line, level and straight."""

    name: Name = Field(description="name of the line in the truth and the picture")
    from_m: Point = Field(description="east, north of its start")
    to_m: Point = Field(description="east, north of its end")
    height_m: float = Field(description="ellipsoidal height")
    speed_mps: float | None = Field(
        None, ge=10.0, le=150.0, description="speed over the ground; absent: that of the flight"
    )


class ControlTable(Section):
    """``[control]``: ground control points on flat places in the open."""

    points: int = Field(20, ge=0, le=10_000, description="number of points")
    sigma_m: float = Field(0.01, ge=0.0, le=10.0, description="sigma of the survey, for each of three axes")


# ---------------------------------------------------------------------------------------------- clocks, PPS, air


class HostTable(Section):
    """``[host]``: the recording computer's clock and its stamps."""

    clock_ppm: float = Field(-12.0, ge=-200.0, le=200.0, description="its oscillator is fast by this")
    utc_offset_s: float = Field(0.02, ge=-5.0, le=5.0, description="its wall clock is ahead of UTC by this")
    pps_jitter_us: float = Field(1.0, ge=0.0, le=1000.0, description="sigma of its stamps of edges")
    udp_jitter_us: float = Field(30.0, ge=0.0, le=10_000.0, description="mean delay of its stamps of datagrams")
    can_jitter_us: float = Field(60.0, ge=0.0, le=10_000.0, description="mean delay of its stamps of frames")
    serial_read_ms: float = Field(10.0, gt=0.0, le=100.0, description="interval between reads of a serial port")


class PpsTable(Section):
    """``[pps.<name>]``: a pulse per second wired to the host and to the devices that name it."""

    jitter_ns: float = Field(20.0, ge=0.0, le=100_000.0, description="sigma of the pulse itself")


class OscillatorTable(Section):
    """A device's own oscillator; ``oscillator = {…}`` of IMU and scanners."""

    offset_ppm: float = Field(0.0, ge=-1000.0, le=1000.0, description="its frequency is too high by this")
    drift_ppm_per_h: float = Field(0.0, ge=-100.0, le=100.0, description="increase of the offset in an hour")
    wander_ppm: float = Field(0.0, ge=0.0, le=10.0, description="amplitude of a slow wave of ten minutes")
    ticks_at_start: int = Field(0, ge=0, lt=2**63, description="first value of the counter; determines when it wraps")


class AtmosphereTable(Section):
    """``[atmosphere]``: the air's effect on light; keys as in the configuration."""

    ranges: Literal["corrected", "vacuum"] = Field(
        "corrected", description="vacuum: the scanner computes ranges with c"
    )
    model: Literal["standard", "measured"] = Field(
        "standard", description="model of the air: standard atmosphere, or measured values"
    )
    temperature_c: float = Field(15.0, ge=-80.0, le=60.0, description="measured temperature")
    pressure_hpa: float = Field(1013.25, ge=100.0, le=1100.0, description="measured pressure")
    humidity_percent: float = Field(50.0, ge=0.0, le=100.0, description="measured relative humidity")
    height_m: float = Field(0.0, ge=-500.0, le=12_000.0, description="height of the measurement")
    refraction: Literal["none", "ardc", "spherical"] = Field("none", description="model by which beams bend")
    visibility_km: float = Field(23.0, gt=0.0, description="visibility; echoes from afar are weaker")


# ---------------------------------------------------------------------------------------------- GNSS and IMU


class OutageTable(Section):
    """``[[gnss.<name>.outage]]``: a time without satellites."""

    at_s: NotNegative = Field(description="seconds after the start")
    for_s: Positive = Field(description="duration")


class JumpTable(Section):
    """``[[gnss.<name>.jump]]``: a wrong fix, as after a cycle slip."""

    at_s: NotNegative = Field(description="seconds after the start")
    for_s: Positive = Field(description="duration")
    offset_l_m: Vector = Field(description="error north, east, down")


class GnssTable(Section):
    """``[gnss.<name>]``: a GNSS receiver."""

    protocol: Literal["novatel", "ubx", "nmea"] = Field("novatel", description="protocol of its messages")
    pps: Wired = Field("main", description='[pps.<name>] that it drives; "": none')
    baud: int = Field(460_800, ge=4800, le=4_000_000, description="rate of its serial line")
    grade: Literal["rtk", "ppk", "spp"] = Field("rtk", description="quality of its positions")
    rate_hz: Literal[1, 2, 5, 10, 20] = Field(5, description="rate of positions and velocities")
    lever_arm_m: Vector = Field(
        default_factory=lambda: [0.10, -0.05, -1.20], description="lever arm of the antenna, x_a^b"
    )
    secondary_lever_arm_m: Vector | None = Field(
        None, description="lever arm of a second antenna; adds heading and pitch"
    )
    ins: bool = Field(False, description="novatel: adds solutions of its own INS at 100 Hz, INSPVAX once a second")
    latency_ms: float = Field(60.0, ge=0.0, le=2000.0, description="delay from an epoch to its first byte")
    undulation_m: float = Field(
        48.0, ge=-120.0, le=120.0, description="height of the geoid above the ellipsoid that it reports"
    )
    outage: list[OutageTable] = Field(default_factory=list)
    jump: list[JumpTable] = Field(default_factory=list)


class ImuNoiseTable(Section):
    """``[imu.<name>.noise]``: keys of the configuration and further ones of the simulator; they override the grade."""

    angle_random_walk_deg_per_sqrt_h: float | None = Field(None, ge=0.0, description="white noise of the gyroscopes")
    velocity_random_walk_m_per_s_per_sqrt_h: float | None = Field(
        None, ge=0.0, description="white noise of the accelerometers"
    )
    gyro_bias_deg_per_h: float | None = Field(None, ge=0.0, description="bias of the gyroscopes at turn-on, one sigma")
    accel_bias_mg: float | None = Field(None, ge=0.0, description="bias of the accelerometers at turn-on, one sigma")
    gyro_bias_instability_deg_per_h: float | None = Field(
        None, ge=0.0, description="gyroscopes: floor of the Allan deviation"
    )
    accel_bias_instability_mg: float | None = Field(
        None, ge=0.0, description="accelerometers: floor of the Allan deviation"
    )
    bias_correlation_h: float | None = Field(None, gt=0.0, description="longest time constant of the biases' drift")
    gyro_scale_ppm: float | None = Field(None, ge=0.0, description="scale factor of the gyroscopes, one sigma")
    accel_scale_ppm: float | None = Field(None, ge=0.0, description="scale factor of the accelerometers, one sigma")
    misalignment_mrad: float | None = Field(None, ge=0.0, description="misalignment of each axis, one sigma")


class ImuTable(Section):
    """``[imu.<name>]``: an IMU on CAN, described by a DBC of its own."""

    grade: Literal["navigation", "tactical", "mems", "consumer", "perfect"] = Field(
        "tactical", description="quality of its sensors; noise overrides it"
    )
    rate_hz: int = Field(200, ge=10, le=2000, description="rate of samples")
    pps: Wired = Field("main", description='[pps.<name>] that latches its counter; "": none')
    rotation_b_imu: Matrix = Field(default_factory=_identity, description="b from the IMU's axes, rows of the matrix")
    tick_hz: int = Field(1_000_000, ge=1000, le=100_000_000, description="frequency of its counter")
    tick_bits: Literal[16, 24, 32] = Field(32, description="width of the counter")
    latency_us: float = Field(0.0, ge=-100_000.0, le=100_000.0, description="its stamps are late by this: imu_latency")
    oscillator: OscillatorTable = Field(default_factory=OscillatorTable, description="oscillator of its counter")
    noise: ImuNoiseTable = Field(default_factory=ImuNoiseTable, description="single figures that replace the grade's")


# ---------------------------------------------------------------------------------------------- scanners


class ParameterTable(Section):
    """``[scanner.<name>.true]`` and ``[…nominal]``: keys, signs and units of a calibration file."""

    omega_deg: float = Field(0.0, ge=-360.0, le=360.0, description="boresight ω")
    phi_deg: float = Field(0.0, ge=-360.0, le=360.0, description="boresight φ")
    kappa_deg: float = Field(0.0, ge=-360.0, le=360.0, description="boresight κ")
    range_offset_m: float = Field(0.0, description="offset, added to ranges")
    range_scale_ppm: float = Field(0.0, description="scale of ranges")
    scan_angle_offset_deg: float = Field(
        0.0, ge=-360.0, le=360.0, description="the encoder's reading at the centre of the scan"
    )
    scan_angle_scale_ppm: float = Field(0.0, description="scale of scan angles")
    scan_plane_tilt_deg: float = Field(0.0, ge=-360.0, le=360.0, description="scan plane tilt Δη")
    lever_arm_x_m: float = Field(0.12, description="lever arm x_s^b, forward")
    lever_arm_y_m: float = Field(-0.03, description="lever arm x_s^b, right")
    lever_arm_z_m: float = Field(0.28, description="lever arm x_s^b, down")
    time_offset_us: float = Field(0.0, description="the scanner's stamps are early by this")
    imu_latency_us: float = Field(0.0, description="nominal value; the true one is `latency_us` of the IMU")
    encoder_latency_us: float = Field(0.0, description="factor of the scan's rate, added to the angle")
    torsion_us2: float = Field(0.0, description="factor of the scan's acceleration, added to the angle")
    pitch_slope_ppm: float = Field(0.0, description="change of φ with the scan angle")


class IbrcTable(Section):
    """``[scanner.<name>.ibrc]``: the range correction that depends on intensity; keys of a calibration file."""

    intensity: list[float] = Field(min_length=2, description="intensities, rising")
    correction_m: list[float] = Field(min_length=2, description="subtracted from the range at each intensity")


class FacetTable(Section):
    """``[[scanner.<name>.facet]]``: a facet's own tilt (pyramid error)."""

    index: int = Field(ge=0, description="number of the facet, from 0")
    tilt_deg: float = Field(ge=-360.0, le=360.0, description="tilt of its normal towards forward")


class BeamErrorTable(Section):
    """``[[scanner.<name>.beam]]``: corrections of one beam of a multi-beam head."""

    channel: int = Field(ge=0, description="number of the beam, from 0")
    azimuth_deg: float = Field(0.0, ge=-360.0, le=360.0, description="correction, added to its azimuth")
    elevation_deg: float = Field(0.0, ge=-360.0, le=360.0, description="correction, added to its elevation")
    range_m: float = Field(0.0, description="correction, added to its ranges")


class RangeNoiseTable(Section):
    """``[scanner.<name>.range_noise]``: one sigma of a range, by intensity and incidence."""

    sigma_m: float = Field(0.015, ge=0.0, description="sigma at a tenth of full intensity and perpendicular incidence")
    footprint: float = Field(
        0.25, ge=0.0, description="share of the footprint's depth on a slope that adds to the noise"
    )
    drawn: bool = Field(
        False, description="take the range of one place of the footprint, drawn anew, instead of noise by its depth"
    )


ScannerKind = Literal["oscillating", "polygon", "monogon", "nutating", "risley", "rosette", "vlp16", "os1"]


class ScannerTable(Section):
    """``[scanner.<name>]``: a scanner; docs/simulation.md names the keys that a kind does not use and ignores."""

    kind: ScannerKind = Field("oscillating", description="mechanism that deflects the beam")
    motion: Literal["sine", "triangle"] = Field("sine", description="oscillating: motion of the mirror")
    pps: Wired = Field("main", description='[pps.<name>] that latches or sets its counter; "": none')
    prf_hz: float = Field(
        100_000.0, ge=100.0, le=2_000_000.0, description="pulses a second; vlp16, os1: fixed by the head"
    )
    scan_hz: float = Field(
        40.0, gt=0.0, le=1000.0, description="oscillations, or turns of the shaft or head, a second; os1: 10 or 20"
    )
    half_angle_deg: float = Field(
        30.0, gt=0.0, le=89.0, description="half the angle of the scan; ignored for heads of many beams"
    )
    facets: int = Field(4, ge=2, le=64, description="polygon: number of facets")
    nutation_deg: float = Field(
        7.0, gt=0.0, le=20.0, description="nutating: angle between the mirror's normal and its shaft"
    )
    wedge_deg: Point = Field(default_factory=lambda: [10.0, 10.0], description="risley: angles of the two prisms")
    refractive_index: float = Field(1.51, gt=1.0, le=4.0, description="risley: refractive index of the prisms")
    prism_ratio: float = Field(
        -0.7265625, description="risley, rosette: turns of the second prism per turn of the first"
    )
    encoder_counts: int = Field(4_194_304, ge=1000, le=2**30, description="counts in a turn of the shaft")
    tick_hz: int = Field(
        10_000_000, ge=100_000, le=1_000_000_000, description="frequency of its counter; vlp16, os1: fixed by the head"
    )
    oscillator: OscillatorTable = Field(
        default_factory=OscillatorTable, description="oscillator of its counter and of its pulses"
    )
    return_slots: int = Field(
        3, ge=1, le=7, description="returns of a pulse that are kept; vlp16, os1: fixed by the head"
    )
    pulses_per_datagram: int = Field(100, ge=1, le=4000, description="SREP: pulses in a datagram")
    zone: Literal["resolved", "apparent"] = Field(
        "resolved", description="pulses in air: ranges are whole, or count from the last emission before the echo"
    )
    dual_return: bool = Field(False, description="vlp16, os1: two returns for each pulse")
    wavelength_nm: float = Field(1064.0, ge=300.0, le=2000.0, description="wavelength in vacuum")
    divergence_mrad: float = Field(0.5, ge=0.0, le=10.0, description="divergence of the beam, full angle")
    pulse_ns: float = Field(3.0, gt=0.0, le=50.0, description="length of the pulse; echoes closer together become one")
    direction_sigma_deg: float = Field(
        0.0, ge=0.0, le=5.0, description="rosette: sigma of each of the two angles that it reports"
    )
    range_min_m: float = Field(20.0, ge=0.0, description="least range that is measured")
    range_max_m: float = Field(3000.0, gt=0.0, description="greatest range that is measured")
    reference_range_m: float = Field(1000.0, gt=0.0, description="range at which full reflectance gives full intensity")
    model: str = Field("SIM", description="model of the head, in its calibration")
    serial: str = Field("1", description="serial number of the head, in its calibration")
    installation: Matrix = Field(default_factory=_identity, description="installation matrix T, b from s")
    true: ParameterTable = Field(default_factory=ParameterTable, description="the real scanner")
    nominal: ParameterTable = Field(default_factory=ParameterTable, description="the scanner's nominal values")
    ibrc: IbrcTable | None = Field(None, description="intensity-dependent range")
    facet: list[FacetTable] = Field(default_factory=list, description="polygon: tilts of facets")
    beam: list[BeamErrorTable] = Field(default_factory=list, description="vlp16, os1: corrections of beams")
    range_noise: RangeNoiseTable = Field(default_factory=RangeNoiseTable, description="noise of ranges")
    on_lines_only: bool = Field(True, description="the laser is off in turns; false: it is always on")


# ---------------------------------------------------------------------------------------------- faults

FaultKind = Literal[
    "silent", "late", "corrupted", "duplicated", "reordered", "unplugged", "pps_lost", "pps_spurious", "clock_step"
]


class FaultTable(Section):
    """``[[fault]]``: a fault of a source for some time."""

    source: str = Field(
        pattern=r"^(host|(gnss|imu|scanner|pps)/[A-Za-z0-9_-]+(/aux)?)$", description="kind/name of the source, or host"
    )
    kind: FaultKind = Field(description="kind of the fault")
    at_s: NotNegative = Field(description="seconds after the start")
    for_s: NotNegative = Field(0.0, description="duration; 0: at that moment only")
    delay_s: float = Field(0.5, gt=0.0, le=60.0, description="late: delay")
    share: float = Field(1.0, gt=0.0, le=1.0, description="share of the units that are affected")
    step_s: float = Field(3600.0, ge=-100_000.0, le=100_000.0, description="clock_step: step of the wall clock")


class Tables(Section):
    """All tables of a plan."""

    flight: FlightTable
    ground: GroundStart | None = None
    line: list[LineTable] = Field(min_length=1)
    terrain: TerrainTable = Field(default_factory=TerrainTable)
    control: ControlTable = Field(default_factory=ControlTable)
    host: HostTable = Field(default_factory=HostTable)
    pps: dict[Name, PpsTable] = Field(default_factory=lambda: {"main": PpsTable()})
    atmosphere: AtmosphereTable = Field(default_factory=AtmosphereTable)
    gnss: dict[Name, GnssTable] = Field(default_factory=lambda: {"rover": GnssTable()})
    imu: dict[Name, ImuTable] = Field(default_factory=lambda: {"main": ImuTable()})
    scanner: dict[Name, ScannerTable] = Field(default_factory=lambda: {"left": ScannerTable()})
    fault: list[FaultTable] = Field(default_factory=list)
