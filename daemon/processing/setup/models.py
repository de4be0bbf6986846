"""A scanner's model from its tables of the configuration: geometry, mount, air, noise."""

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
from swath.georef.arrays import FloatArray
from swath.georef.coarse_terrain import CoarseTerrain
from swath.georef.georeference import Georeferencer
from swath.georef.mapping.frame import Mapping
from swath.georef.points import Fate
from swath.georef.records import InsSolution, Int64Array, StructArray
from swath.georef.scanner.beams import Geometry, OusterGeometry, SpinningGeometry, line_scanner, read_fibres
from swath.georef.scanner.calibration import Calibration
from swath.georef.scanner.encoder_motion import EncoderMotion
from swath.georef.scanner.mount import AngleSeries, Mount, Stage
from swath.georef.scanner.ranging import PulseRates, ZoneResolver
from swath.georef.scanner.sensor_model import SensorModel
from swath.georef.scanner.uncertainty import Noise, Uncertainty
from swath.georef.stream.stream import GivenMotion, ScannerChain
from swath.georef.text_encoding import decoded
from swath.georef.trajectory.trajectory import Trajectory

USUAL_WAVELENGTH_NM = 1064.0  # of airborne scanners
INSTALLATION_TOLERANCE = 1e-6
FAR_M = 1000.0  # along a beam, to tell its direction
NO_ANGLES = AngleSeries(np.array([-2, -1]), np.zeros((2, 3)))  # at no time there is


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
) -> Georeferencer:
    """Return what makes points of a scanner's returns.

    Args:
        config: with [scanner.<name>] and [atmosphere].
        name: of the scanner.
        calibration: in use.
        parser: of the scanner: heads with several beams have their table there.
        fibres: of a fibre scanner the file of its geometry.
        mapping: None: points stay in e.
        uncertainty: with sigmas.
        angles: of the gimbal's stages, by the source that logged them; None: the log is yet to be read for them.

    Raises:
        ValueError: something cannot be meant, one line.
    """
    table = config.scanner[name]
    if not isinstance(parser, SrepParser) and any(row.prf_hz is not None for row in calibration.range_offsets):
        text = f"{table.protocol} tells no pulse rate; want return_slot or mta_zone"
        raise ValueError(f"calibration {calibration.id}: range_offset.prf_hz: {text}")
    for number, source in gimbal_sources(config, name):
        if not tells_attitude(config, source):
            text = f'"{source}" tells no angles of a gimbal; want angles_deg, or an imu/name or gnss/name with an INS'
            raise ValueError(f"gimbal.stages[{number}].source: {text}")
    model = SensorModel(
        calibration,
        geometry_of(table, parser, fibres),
        (table.range_min_m, table.range_max_m),
        mount_of(table.gimbal, angles),
        air_of(config, table),
    )
    noise = Noise(table.range_sigma_m, np.radians(table.angle_sigma_deg), divergence_rad=1e-3 * table.divergence_mrad)
    sigmas = Uncertainty(calibration, noise) if uncertainty else None
    return Georeferencer(model, mapping, sigmas, GivenMotion() if model.needs_encoder_motion else None)


def geometry_of(table: ScannerConfig, parser: Parser, fibres: bytes | None = None) -> Geometry:
    """Return how the beam goes: by the protocol's table of beams, or of a line scanner as the configuration declares.

    Raises:
        ValueError: the protocol says neither, one line.
    """
    beams, head = getattr(parser, "beams", None), getattr(parser, "head", None)
    if isinstance(head, OusterHead):
        return OusterGeometry(head.altitude_rad, head.azimuth_rad, head.beam_origin_m, head.sensor_from_lidar)
    if isinstance(beams, BeamTable):
        return SpinningGeometry(
            beams.elevation_deg, beams.azimuth_deg, beams.range_m, beams.right_m, beams.forward_m, beams.up_m
        )
    if not find_driver("scanner", table.protocol).line_scanner:
        raise ValueError(f"protocol {table.protocol}: its parser has no beams and it is no line scanner; want either")
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
    """Return stages of a gimbal: ``angles_deg`` and, where a source is named, the roll, pitch and heading it told.

    Args:
        gimbal: of the scanner; None: a rigid mount.
        angles: by source; None: nothing is known yet, returns of such a mount have no place.

    Raises:
        ValueError: a source told no angles.
    """
    stages = []
    for number, stage in enumerate(gimbal.stages if gimbal is not None else []):
        series = None
        if stage.source is not None:
            series = NO_ANGLES if angles is None else angles.get(stage.source)
            if series is None:
                raise ValueError(f'gimbal.stages[{number}].source: "{stage.source}" told no angles')
        angles_rad = np.radians(np.array(stage.angles_deg, dtype=np.float64))
        stages.append(Stage(angles_rad, np.array(stage.lever_arm_m, dtype=np.float64), series))
    return Mount(tuple(stages))


def gimbal_sources(config: Config, name: str) -> Iterator[tuple[int, str]]:
    """Yield stages of a scanner's gimbal whose angles are logged: number, and the source, ``imu/name`` or
    ``gnss/name``.
    """
    gimbal = config.scanner[name].gimbal
    for number, stage in enumerate(gimbal.stages if gimbal is not None else []):
        if stage.source is not None:
            yield number, stage.source


def tells_attitude(config: Config, source: str) -> bool:
    """Return whether a source is one of the configuration's and gives an INS's solutions."""
    for kind, name, table in config.device_tables():
        if f"{kind}/{name}" == source:
            return InsSolution in find_driver(kind, table.protocol).yields
    return False


def refuse_logged_gimbals(config: Config, scanners: list[str]) -> None:
    """For who cannot wait for the end of the log.

    Raises:
        ValueError: a gimbal's angles are logged, one line.
    """
    for name in scanners:
        for number, source in gimbal_sources(config, name):
            where = f"scanner.{name}.gimbal.stages[{number}].source"
            raise ValueError(f'{where}: angles of "{source}" are known when the log is whole: want swath georef')


def air_of(config: Config, table: ScannerConfig) -> Air:
    """Of [atmosphere], for a scanner's light."""
    usual = find_driver("scanner", table.protocol).wavelength_nm or USUAL_WAVELENGTH_NM
    return Air(**config.atmosphere.model_dump(), wavelength_nm=table.wavelength_nm or usual)


def make_resolver(table: ScannerConfig, height_above_ground_m: float | None) -> ZoneResolver | None:
    """Return what finds the emissions of a scanner that may have several pulses in air; None for heads that never
    do.
    """
    if table.protocol != "srep":
        return None
    kind = table.geometry.type if table.geometry is not None else None
    slanted = kind not in ("nutating", "risley")
    return ZoneResolver(table.range_max_m, height_above_ground_m, slanted=slanted, every_pulse=True)


def connect(chain: ScannerChain, parser: Parser) -> None:
    """Have a parser tell the chain its returns go through every pulse that left, and at which rates."""
    if not isinstance(parser, SrepParser):
        return
    rates = PulseRates()
    parser.emissions, parser.tell_rates = chain.resolver is not None, rates.note
    if isinstance(chain.resolver, ZoneResolver):
        chain.resolver.rates = rates
    if isinstance(chain.georeferencer, Georeferencer):
        chain.georeferencer.rates = rates


def make_motion(table: ScannerConfig, model: SensorModel) -> EncoderMotion | None:
    """Return what tells how the encoder moves; None where the calibration does not ask."""
    return motion_of(table) if model.needs_encoder_motion else None


def motion_of(table: ScannerConfig) -> EncoderMotion:
    """Return what tells how a scanner's encoder moves."""
    kind = table.geometry.type if table.geometry is not None else None
    swings = table.protocol == "srep" and kind in (None, "oscillating")
    return EncoderMotion(steady=not swings, facets=kind == "polygon")


class TerrainRanges:
    """Ranges that a terrain model expects of a scanner's beams: `swath.georef.stream.stream.ScannerChain.predict`."""

    def __init__(self, model: SensorModel, terrain: CoarseTerrain) -> None:
        self._terrain = terrain
        self._model = SensorModel(model.calibration, model.geometry, mount=model.mount)

    def __call__(self, rows: StructArray, time_ns: Int64Array, trajectory: Trajectory) -> FloatArray:
        """Return (n,) metres of rows at GPS times (n,); nan where nothing is known. The encoder's latency does not
        count.
        """
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
        yield f'calibration.scanner: is of scanner "{calibration.scanner}", want "{name}"'
    for key in ("model", "serial"):
        theirs, ours = calibration.header.get(f"scanner_{key}", ""), getattr(table, key)
        if theirs and ours and theirs != ours:
            yield f'calibration.scanner_{key}: of another head: "{theirs}", the configuration says "{ours}"'
    for key, theirs, ours in (
        ("ranges", calibration.ranges, air.ranges),
        ("refraction", calibration.refraction, air.refraction),
    ):
        if theirs is not None and theirs != ours:
            yield (
                f'calibration.{key}: was estimated with {key} = "{theirs}", [atmosphere] says "{ours}"; '
                "set that alike, or calibrate anew"
            )
    ours_factor = table.mirror_factor
    if None not in (calibration.mirror_factor, ours_factor) and calibration.mirror_factor != ours_factor:
        yield (
            f"calibration.mirror_factor: was estimated with {calibration.mirror_factor:g}, "
            f"the configuration says {ours_factor:g}"
        )
    if table.installation is not None:
        apart = np.abs(calibration.installation_matrix - np.array(table.installation)).max()
        if apart > INSTALLATION_TOLERANCE:
            yield (
                "calibration.installation_matrix: is not the configuration's installation; "
                "make both the same, or leave the configuration's out"
            )
