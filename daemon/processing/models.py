"""A scanner's model from its tables of the configuration: geometry, mount, air, noise."""

from __future__ import annotations

import numpy as np

from daemon.config.config import Config
from daemon.config.tables import GimbalConfig, ScannerConfig
from drivers.core.parser import Parser
from drivers.scanner.beams import BeamTable
from drivers.scanner.ouster_head import OusterHead
from georef.atmosphere import Air
from georef.beams import Geometry, OusterGeometry, SpinningGeometry, line_scanner, read_fibres
from georef.calibration import Calibration
from georef.coarse_terrain import CoarseTerrain
from georef.encoder_motion import EncoderMotion
from georef.georeference import Georeferencer
from georef.mapping import Mapping
from georef.mount import Mount, Stage
from georef.points import Fate
from georef.ranging import ZoneResolver
from georef.records import Int64Array, StructArray
from georef.sensor_model import FloatArray, SensorModel
from georef.stream import GivenMotion
from georef.trajectory import Trajectory
from georef.uncertainty import Noise, Uncertainty

# of the makers' data sheets; airborne scanners mostly 1064
WAVELENGTH_NM = {"velodyne": 903.0, "hesai": 905.0, "ouster": 865.0}
USUAL_WAVELENGTH_NM = 1064.0
FAR_M = 1000.0  # along a beam, to tell its direction


def make_georeferencer(
    config: Config,
    name: str,
    calibration: Calibration,
    parser: Parser,
    fibres: bytes | None,
    mapping: Mapping | None,
    *,
    uncertainty: bool,
) -> Georeferencer:
    """What makes points of a scanner's returns.

    Args:
        config: with [scanner.<name>] and [atmosphere].
        name: of the scanner.
        calibration: in use.
        parser: of the scanner: heads with several beams have their table there.
        fibres: of a fibre scanner the file of its geometry.
        mapping: None: points stay in e.
        uncertainty: with sigmas.

    Raises:
        ValueError: something cannot be meant, one line.
    """
    table = config.scanner[name]
    model = SensorModel(
        calibration,
        geometry_of(table, parser, fibres),
        (table.range_min_m, table.range_max_m),
        mount_of(table.gimbal),
        air_of(config, table),
    )
    noise = Noise(table.range_sigma_m, np.radians(table.angle_sigma_deg), divergence_rad=1e-3 * table.divergence_mrad)
    sigmas = Uncertainty(calibration, noise) if uncertainty else None
    return Georeferencer(model, mapping, sigmas, GivenMotion() if model.needs_encoder_motion else None)


def geometry_of(table: ScannerConfig, parser: Parser, fibres: bytes | None = None) -> Geometry:
    """How the beam goes: by the protocol's table of beams where it has one, else as the configuration declares."""
    beams, head = getattr(parser, "beams", None), getattr(parser, "head", None)
    if isinstance(head, OusterHead):
        return OusterGeometry(head.altitude_rad, head.azimuth_rad, head.beam_origin_m, head.sensor_from_lidar)
    if isinstance(beams, BeamTable):
        return SpinningGeometry(
            beams.elevation_deg, beams.azimuth_deg, beams.range_m, beams.right_m, beams.forward_m, beams.up_m
        )
    geometry = table.geometry
    if geometry is None:
        return line_scanner(None)
    read = None
    if geometry.type == "fibre" and fibres is not None:
        read = read_fibres(fibres.decode("utf-8", "replace"), geometry.file or "geometry.file")
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


def mount_of(gimbal: GimbalConfig | None) -> Mount:
    """Stages that stand still.

    Raises:
        ValueError: a stage's angles are to come from a source, and no protocol tells any.
    """
    stages = []
    for number, stage in enumerate(gimbal.stages if gimbal is not None else []):
        if stage.source is not None:
            raise ValueError(
                f'gimbal.stages[{number}].source: "{stage.source}" tells no angles of a gimbal; want angles_deg'
            )
        angles_rad = np.radians(np.array(stage.angles_deg, dtype=np.float64))
        stages.append(Stage(angles_rad, np.array(stage.lever_arm_m, dtype=np.float64)))
    return Mount(tuple(stages))


def air_of(config: Config, table: ScannerConfig) -> Air:
    """Of [atmosphere], for a scanner's light."""
    usual = WAVELENGTH_NM.get(table.protocol.partition("-")[0], USUAL_WAVELENGTH_NM)
    return Air(**config.atmosphere.model_dump(), wavelength_nm=table.wavelength_nm or usual)


def make_resolver(table: ScannerConfig, height_above_ground_m: float | None) -> ZoneResolver | None:
    """What finds the emissions of a scanner that may have several pulses in air; None for heads that never do."""
    if table.protocol != "srep":
        return None
    kind = table.geometry.type if table.geometry is not None else None
    return ZoneResolver(table.range_max_m, height_above_ground_m, slanted=kind not in ("nutating", "risley"))


def make_motion(table: ScannerConfig, model: SensorModel) -> EncoderMotion | None:
    """What tells how the encoder moves; None where the calibration does not ask."""
    if not model.needs_encoder_motion:
        return None
    kind = table.geometry.type if table.geometry is not None else None
    swings = table.protocol == "srep" and kind in (None, "oscillating")
    return EncoderMotion(steady=not swings, facets=kind == "polygon")


class TerrainRanges:
    """Ranges that a terrain model expects of a scanner's beams: `georef.stream.ScannerChain.predict`."""

    def __init__(self, model: SensorModel, terrain: CoarseTerrain) -> None:
        self._terrain = terrain
        self._model = SensorModel(model.calibration, model.geometry, mount=model.mount)

    def __call__(self, rows: StructArray, time_ns: Int64Array, trajectory: Trajectory) -> FloatArray:
        """(n,) metres of rows at GPS times (n,); nan where nothing is known. The encoder's latency does not count."""
        far, still = rows.copy(), np.zeros(len(rows))
        far["range_m"] = FAR_M
        rays = self._model.rays(far, time_ns, trajectory, encoder_rate=still, encoder_acceleration=still)
        known = rays.fate == Fate.GEOREFERENCED
        along_e = rays.points_e[known] - rays.origin_e[known]
        along_e /= np.linalg.norm(along_e, axis=1, keepdims=True)
        ranges_m = np.full(len(rows), np.nan)
        ranges_m[known] = self._terrain.predicted_m(rays.origin_e[known], along_e)
        return ranges_m
