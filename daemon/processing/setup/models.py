"""Builds a scanner's model from its tables of the configuration: geometry, mount, air, noise."""

from __future__ import annotations

from collections.abc import Iterator
from collections.abc import Mapping as ByName
from types import MappingProxyType

import numpy as np

from swath.daemon.config.config import Config
from swath.daemon.config.tables import AtmosphereConfig, GimbalConfig, ScannerConfig
from swath.drivers.driver import find_driver
from swath.drivers.parser import Parser
from swath.drivers.scanner.beams import BeamTable
from swath.drivers.scanner.ouster.head import OusterHead
from swath.drivers.scanner.srep.parser import SrepParser
from swath.georef.air.atmosphere import Air
from swath.georef.arrays import FloatArray, Int64Array, StructArray
from swath.georef.coarse_terrain import CoarseTerrain
from swath.georef.georeference import Georeferencer
from swath.georef.mapping.frame import Mapping
from swath.georef.points import Fate
from swath.georef.records import InsSolution
from swath.georef.scanner.beams import (
    AimedGeometry,
    Geometry,
    OusterGeometry,
    SpinningGeometry,
    line_scanner,
    read_fibres,
)
from swath.georef.scanner.calibration import Calibration
from swath.georef.scanner.encoder_motion import EncoderMotion, NoMotion
from swath.georef.scanner.mount import AngleSeries, Mount, Stage
from swath.georef.scanner.ranging import PulseRates, ZoneResolver
from swath.georef.scanner.sensor_model import SensorModel
from swath.georef.scanner.uncertainty import Noise, Uncertainty
from swath.georef.stream.stream import GivenMotion, Motion, ScannerChain
from swath.georef.text_encoding import decoded
from swath.georef.trajectory.trajectory import Trajectory

USUAL_WAVELENGTH_NM = 1064.0  # of airborne scanners
INSTALLATION_TOLERANCE = 1e-6
FAR_M = 1000.0  # along a beam, to find its direction
NO_ANGLES = AngleSeries(np.array([-2, -1]), np.zeros((2, 3)))  # at impossible times


def make_georeferencer(
    config: Config,
    name: str,
    calibration: Calibration,
    parser: Parser,
    fibres: bytes | None,
    mapping: Mapping | None,
    *,
    uncertainty: bool,
    angles: ByName[str, AngleSeries] | None = MappingProxyType({}),
    with_beams: bool = False,
    with_covariances: bool = False,
) -> Georeferencer:
    """Return the georeferencer of a scanner's returns.

    Args:
        config: configuration with [scanner.<name>] and [atmosphere].
        name: name of the scanner.
        calibration: calibration in use.
        parser: parser of the scanner: for heads with several beams it holds their table.
        fibres: content of a fibre scanner's geometry file.
        mapping: mapping of the points; None: they stay in e.
        uncertainty: True to compute sigmas.
        angles: angles of the gimbal's stages, by the source that logged them; None: they have not been read yet.
        with_beams, with_covariances: of `Georeferencer`.

    Raises:
        ValueError: a setting is invalid; one line.
    """
    table = config.scanner[name]
    if not isinstance(parser, SrepParser) and any(row.prf_hz is not None for row in calibration.range_offsets):
        text = f"{table.protocol} sends no pulse rate; use return_slot or mta_zone"
        raise ValueError(f"calibration {calibration.id}: range_offset.prf_hz: {text}")
    for number, source in gimbal_sources(config, name):
        if not tells_attitude(config, source):
            text = f'"{source}" sends no gimbal angles; set angles_deg, or name an imu/name or gnss/name with an INS'
            raise ValueError(f"gimbal.stages[{number}].source: {text}")
    model = SensorModel(
        calibration,
        geometry_of(table, parser, fibres),
        (table.range_min_m, table.range_max_m),
        mount_of(table.gimbal, angles),
        air_of(config, table),
    )
    sigmas = Uncertainty(calibration, noise_of(table), aimed=model.aimed) if uncertainty else None
    motion = GivenMotion() if model.needs_encoder_motion else None
    return Georeferencer(model, mapping, sigmas, motion, with_beams=with_beams, with_covariances=with_covariances)


def noise_of(table: ScannerConfig) -> Noise:
    """Return the noise of a scanner's returns, by its table."""
    angle_rad = float(np.radians(table.angle_sigma_deg))
    return Noise(table.range_sigma_m, angle_rad, divergence_rad=1e-3 * table.divergence_mrad)


def geometry_of(table: ScannerConfig, parser: Parser, fibres: bytes | None = None) -> Geometry:
    """Return the geometry of the beams: from the protocol's table of beams, or as configured for a line scanner.

    Raises:
        ValueError: the protocol has neither; one line.
    """
    beams, head = getattr(parser, "beams", None), getattr(parser, "head", None)
    if isinstance(head, OusterHead):
        return OusterGeometry(head.altitude_rad, head.azimuth_rad, head.beam_origin_m, head.sensor_from_lidar)
    if isinstance(beams, BeamTable):
        return SpinningGeometry(
            beams.elevation_deg, beams.azimuth_deg, beams.range_m, beams.right_m, beams.forward_m, beams.up_m
        )
    driver = find_driver("scanner", table.protocol)
    if driver.aimed:
        return AimedGeometry()
    if not driver.line_scanner:
        raise ValueError(
            f"protocol {table.protocol}: its parser has no beam table, its returns have no elevation, and it is not a "
            "line scanner; use a protocol with one of these"
        )
    geometry = table.geometry
    if geometry is None:
        return line_scanner(None)
    read = None
    if geometry.type == "fibre" and fibres is not None:
        read = read_fibres(decoded(fibres, "replace"), geometry.file or "geometry.file")
    return line_scanner(
        geometry.type,
        facets=geometry.facets,
        nutation_deg=geometry.nutation_deg,
        shaft_angle_deg=geometry.shaft_angle_deg,
        wedge_deg=geometry.wedge_deg,
        refractive_index=geometry.refractive_index,
        prism_ratio=geometry.prism_ratio,
        fibres=read,
    )


def mount_of(gimbal: GimbalConfig | None, angles: ByName[str, AngleSeries] | None = None) -> Mount:
    """Return the stages of a gimbal: ``angles_deg`` and, with a source, the roll, pitch and heading that it sent.

    Args:
        gimbal: gimbal of the scanner; None: a rigid mount.
        angles: angles by source; None: not known yet, so that returns on such a mount have no place.

    Raises:
        ValueError: a source sent no angles.
    """
    stages = []
    for number, stage in enumerate(gimbal.stages if gimbal is not None else []):
        series = None
        if stage.source is not None:
            series = NO_ANGLES if angles is None else angles.get(stage.source)
            if series is None:
                raise ValueError(f'gimbal.stages[{number}].source: "{stage.source}" sent no angles')
        angles_rad = np.radians(np.array(stage.angles_deg, dtype=np.float64))
        stages.append(Stage(angles_rad, np.array(stage.lever_arm_m, dtype=np.float64), series))
    return Mount(tuple(stages))


def gimbal_sources(config: Config, name: str) -> Iterator[tuple[int, str]]:
    """Yield number and source (``imu/name`` or ``gnss/name``) of a gimbal's stages whose angles are logged."""
    gimbal = config.scanner[name].gimbal
    for number, stage in enumerate(gimbal.stages if gimbal is not None else []):
        if stage.source is not None:
            yield number, stage.source


def tells_attitude(config: Config, source: str) -> bool:
    """Return True if a source is in the configuration and gives an INS's solutions."""
    for kind, name, table in config.device_tables():
        if f"{kind}/{name}" == source:
            return InsSolution in find_driver(kind, table.protocol).yields
    return False


def refuse_logged_gimbals(config: Config, scanners: list[str]) -> None:
    """Refuse scanners on gimbals with logged angles, for commands that cannot wait for the end of the log.

    Raises:
        ValueError: a gimbal's angles are logged; one line.
    """
    for name in scanners:
        for number, source in gimbal_sources(config, name):
            where = f"scanner.{name}.gimbal.stages[{number}].source"
            raise ValueError(
                f'{where}: angles of "{source}" are known only from a complete log; use swath georef after the '
                "recording"
            )


def air_of(config: Config, table: ScannerConfig) -> Air:
    """Return the air of [atmosphere] at a scanner's wavelength."""
    usual = find_driver("scanner", table.protocol).wavelength_nm or USUAL_WAVELENGTH_NM
    return Air(**config.atmosphere.model_dump(), wavelength_nm=table.wavelength_nm or usual)


def make_resolver(table: ScannerConfig, height_above_ground_m: float | None) -> ZoneResolver | None:
    """Return the resolver of emissions for a scanner with several pulses in air; None for heads
    that never have them.
    """
    if table.protocol != "srep":
        return None
    kind = table.geometry.type if table.geometry is not None else None
    slanted = kind not in ("nutating", "risley")
    return ZoneResolver(table.range_max_m, height_above_ground_m, slanted=slanted, every_pulse=True)


def connect(chain: ScannerChain, parser: Parser) -> None:
    """Let a parser report to the chain of its returns every emitted pulse and the pulse rates."""
    if not isinstance(parser, SrepParser):
        return
    rates = PulseRates()
    parser.emissions, parser.tell_rates = chain.resolver is not None, rates.note
    if isinstance(chain.resolver, ZoneResolver):
        chain.resolver.rates = rates
    if isinstance(chain.georeferencer, Georeferencer):
        chain.georeferencer.rates = rates


def make_motion(table: ScannerConfig, model: SensorModel) -> Motion | None:
    """Return the estimator of the encoder's motion; None if the calibration does not need it."""
    return motion_of(table) if model.needs_encoder_motion else None


def motion_of(table: ScannerConfig) -> Motion:
    """Return the estimator of a scanner's encoder motion."""
    driver = find_driver("scanner", table.protocol)
    if driver.aimed:
        return NoMotion()
    kind = table.geometry.type if table.geometry is not None else None
    swings = driver.line_scanner and kind in (None, "oscillating")
    return EncoderMotion(steady=not swings, facets=kind == "polygon")


class TerrainRanges:
    """Predicts ranges of a scanner's beams from a terrain model: `swath.georef.stream.stream.ScannerChain.predict`."""

    def __init__(self, model: SensorModel, terrain: CoarseTerrain) -> None:
        self._terrain = terrain
        self._model = SensorModel(model.calibration, model.geometry, mount=model.mount)

    def __call__(self, rows: StructArray, time_ns: Int64Array, trajectory: Trajectory) -> FloatArray:
        """Return ranges (n,), m, of rows at GPS times (n,); nan if unknown. The encoder's latency is ignored."""
        asked = np.flatnonzero(rows["number_of_returns"])  # the others are pulses without a return
        far, still = rows.take(asked), np.zeros(len(asked))
        far["range_m"] = FAR_M
        rays = self._model.rays(far, time_ns.take(asked), trajectory, encoder_rate=still, encoder_acceleration=still)
        known = rays.fate == Fate.GEOREFERENCED
        along_e = rays.points_e[known] - rays.origin_e[known]
        along_e /= np.linalg.norm(along_e, axis=1, keepdims=True)
        ranges_m = np.full(len(rows), np.nan)
        ranges_m[asked[known]] = self._terrain.predicted_m(rays.origin_e[known], along_e)
        return ranges_m


def calibration_mistakes(
    calibration: Calibration, name: str, table: ScannerConfig, air: AtmosphereConfig
) -> Iterator[str]:
    """Yield why a calibration is not this scanner's, or was estimated under other settings than those in use."""
    if calibration.scanner != name:
        yield f'calibration.scanner: belongs to scanner "{calibration.scanner}"; use a calibration of "{name}"'
    for key in ("model", "serial"):
        theirs, ours = calibration.header.get(f"scanner_{key}", ""), getattr(table, key)
        if theirs and ours and theirs != ours:
            yield f'calibration.scanner_{key}: belongs to another head: "{theirs}", the configuration has "{ours}"'
    for key, theirs, ours in (
        ("ranges", calibration.ranges, air.ranges),
        ("refraction", calibration.refraction, air.refraction),
    ):
        if theirs is not None and theirs != ours:
            yield (
                f'calibration.{key}: was estimated with {key} = "{theirs}", [atmosphere] has "{ours}"; set both '
                "alike, or calibrate again"
            )
    ours_factor = table.mirror_factor
    if None not in (calibration.mirror_factor, ours_factor) and calibration.mirror_factor != ours_factor:
        yield (
            f"calibration.mirror_factor: was estimated with {calibration.mirror_factor:g}, the configuration has "
            f"{ours_factor:g}; set both alike, or calibrate again"
        )
    if table.installation is not None:
        apart = np.abs(calibration.installation_matrix - np.array(table.installation)).max()
        if apart > INSTALLATION_TOLERANCE:
            yield (
                "calibration.installation_matrix: differs from the configuration's installation; make both equal, or "
                "leave the configuration's out"
            )
