"""Tests what navigation reads of a log: samples, positions, velocities and headings at their own times."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from math import radians
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from pyproj import Transformer
from scipy.spatial.transform import Rotation

from swath.daemon.config import Config
from swath.daemon.config.tables import NoiseConfig
from swath.daemon.errors import ConfigError, UserError
from swath.daemon.log.parsers import stored_config
from swath.daemon.processing.navigation import input_checks
from swath.daemon.processing.navigation.input_checks import height_findings
from swath.daemon.processing.navigation.inputs import InputOptions, NavigationInputs, read_inputs
from swath.daemon.processing.navigation.observations import (
    DEFAULT_SIGMAS,
    Observed,
    fix_observations,
    heading_observations,
    heading_times,
    ins_observations,
)
from swath.daemon.processing.navigation.outside_positions import OutsidePositions, outside_observations, refuse_shifted
from swath.daemon.processing.navigation.sources import NavigationSources, noise_of, without_scanners
from swath.daemon.processing.navigation.times import counted_arrivals, imu_times
from swath.drivers.gnss.nmea.parser import NmeaParser
from swath.drivers.gnss.nmea.sentences import encode_gga
from swath.drivers.parser import DeviceSettings
from swath.georef.arrays import FloatArray, StructArray
from swath.georef.formats.antenna_positions import read_antenna_positions
from swath.georef.navigation.alignment.noise import white_factor
from swath.georef.navigation.diagnosis.data import Finding
from swath.georef.navigation.inputs import GRADES, OBSERVATION_DTYPE, Kind
from swath.georef.records import (
    IMU_DTYPE,
    INS_DTYPE,
    FixType,
    GnssFix,
    GnssHeading,
    NamesEdge,
    PpsEdge,
    TimeMessage,
    TimeScale,
    TimeTag,
)
from swath.georef.stream.clocks import ClockPlan, GnssPlan, HostClocks, PpsPlan
from swath.georef.trajectory.trajectory import Poses
from tests.daemon.short_flight import CLOCK_SIGMA_S, MARK_AFTER_NS, Flown, fly_short
from tests.drivers.harness import feed_pieces

pytestmark = pytest.mark.xdist_group("kernels")

S = 1_000_000_000
PLAN = """
[flight]
name = "inputs"
seed = 3
speed_mps = 50.0
noise = false

[[line]]
name = "1"
from_m = [-400, 0]
to_m = [400, 0]
height_m = 700

[gnss.rover]
rate_hz = 5
secondary_lever_arm_m = [0.9, 0.6, -1.2]

[imu.main]
rate_hz = 100
grade = "perfect"
rotation_b_imu = [[0, 1, 0], [-1, 0, 0], [0, 0, 1]]

[scanner.left]
prf_hz = 500
"""
NMEA = '[gnss.rover]\nprotocol = "nmea"\nundulation_m = 0.0\nrate_hz = 5'
ARM = np.array([0.1, -0.05, -1.2])
BASELINE = np.array([0.8, 0.65, 0.0])


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Flown:
    return fly_short(tmp_path_factory.mktemp("inputs"), PLAN, 18.0)


@pytest.fixture(scope="module")
def inputs(flown: Flown) -> NavigationInputs:
    return read_inputs(flown.session(), InputOptions())


def turned(poses: Poses, vector_b: FloatArray) -> FloatArray:
    """Rotate vectors to e with another library."""
    vector_e: FloatArray = Rotation.from_quat(poses.q_e_from_b[:, [1, 2, 3, 0]]).apply(vector_b)
    return vector_e


class TestInputsOfALog:
    def test_positions_match_the_antenna_at_their_time(self, flown: Flown, inputs: NavigationInputs) -> None:
        rows = inputs.legs[0].observations
        rows, truth = rows[rows["kind"] == Kind.POSITION], flown.truth()
        rows = rows[truth.fates(rows["time_ns"]) == 0]
        assert len(rows) > 60
        assert set(np.diff(rows["time_ns"])) == {200_000_000}
        poses = truth.poses(rows["time_ns"])
        assert np.abs(rows["value"] - poses.position_e - turned(poses, ARM)).max() < 2e-3  # a degree's last digits
        assert np.all(rows["fix_type"] == FixType.RTK_FIXED)
        assert rows["satellites"].min() >= 5
        assert ((rows["sigma"] > 0.001) & (rows["sigma"] < 0.1)).all()

    def test_velocities_refer_to_the_time_given_by_their_latency(self, flown: Flown, inputs: NavigationInputs) -> None:
        rows = inputs.legs[0].observations
        rows, truth = rows[rows["kind"] == Kind.VELOCITY][3:], flown.truth()
        rows = rows[truth.fates(rows["time_ns"]) == 0]
        poses = truth.poses(rows["time_ns"])
        moved_e = poses.velocity_e + turned(poses, np.cross(poses.rate_eb_b, ARM))
        lon, lat, _ = np.radians(Transformer.from_crs(4978, 4979, always_xy=True).transform(*poses.position_e.T))
        up = np.stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)], axis=1)
        east = np.stack([-np.sin(lon), np.cos(lon), np.zeros(len(lon))], axis=1)
        expected = np.stack([(moved_e * axis).sum(axis=1) for axis in (np.cross(up, east), east, -up)], axis=1)
        assert np.abs(rows["value"] - expected).max() < 0.01
        assert (np.abs(rows["time_ns"] % 200_000_000 - 150_000_000) <= 1).all()  # 50 ms before each epoch
        assert inputs.assumed["velocity"] == (inputs.legs[0].observations["kind"] == Kind.VELOCITY).sum()

    def test_headings_match_the_baseline(self, flown: Flown, inputs: NavigationInputs) -> None:
        rows = inputs.legs[0].observations
        rows, truth = rows[rows["kind"] == Kind.HEADING], flown.truth()
        rows = rows[truth.fates(rows["time_ns"]) == 0]
        assert len(rows) == 90
        assert inputs.setup.baseline_b == pytest.approx(BASELINE)
        _, _, heading = truth.attitude()
        at = np.interp(rows["time_ns"] - truth.time_ns[0], truth.time_ns - truth.time_ns[0], np.unwrap(heading))
        of_baseline = at + np.arctan2(BASELINE[1], BASELINE[0])
        off = (rows["value"][:, 0] - of_baseline + np.pi) % (2 * np.pi) - np.pi
        assert np.abs(off).max() < radians(0.6)  # roll and pitch of some degrees turn the baseline's horizontal part

    def test_increments_match_the_motion_of_the_flight(self, flown: Flown, inputs: NavigationInputs) -> None:
        """The axes are those of b, though the IMU has others; each increment has the time of its interval."""
        truth, (leg,) = flown.truth(), inputs.legs
        sample = leg.inertial
        inside = (sample.time_ns < truth.time_ns[-1] - S) & (sample.time_ns > truth.time_ns[0] + S)
        ends, begins = (
            sample.time_ns[inside],
            sample.time_ns[inside] - np.rint(sample.interval_s[inside] * S).astype(int),
        )
        q0, q1 = (Rotation.from_quat(truth.poses(t).q_e_from_b[:, [1, 2, 3, 0]]) for t in (begins, ends))
        relative_to_e = (q0.inv() * q1).as_rotvec()
        of_earth = q0.inv().apply([0.0, 0.0, 7.292115e-5]) * sample.interval_s[inside, np.newaxis]
        assert np.abs(sample.angle_b[inside] - relative_to_e - of_earth).max() < 2e-5
        force = sample.velocity_b[inside] / sample.interval_s[inside, np.newaxis]
        assert force.mean(axis=0)[2] == pytest.approx(-9.81, abs=0.5)
        assert inputs.samples == {"taken": len(sample)}
        assert inputs.imu_time[0] == "latch"
        assert inputs.imu_time[1] < 1e-6

    def test_event_marks_have_the_time_of_the_receiver(self, inputs: NavigationInputs) -> None:
        assert len(inputs.marks) > 10
        for mark in inputs.marks:
            assert mark.gps_ns is not None
            assert abs(mark.gps_ns % S - MARK_AFTER_NS) <= 200  # a double of seconds of the week
            assert mark.event.sigma_s == pytest.approx(CLOCK_SIGMA_S)

    def test_a_sound_log_has_no_warnings_and_no_gaps(self, inputs: NavigationInputs) -> None:
        assert (inputs.warnings, inputs.holes) == ([], [])
        assert inputs.refused == {}

    def test_the_configuration_in_the_log_suffices(
        self, flown: Flown, inputs: NavigationInputs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.chdir(tmp_path)
        config = stored_config(flown.session().attachments())
        again = read_inputs(flown.session(), InputOptions(config=config))
        assert again.samples == inputs.samples

    def test_the_same_log_gives_the_same_inputs(self, flown: Flown, inputs: NavigationInputs) -> None:
        again = read_inputs(flown.session(), InputOptions())
        assert np.array_equal(again.legs[0].inertial.velocity_b, inputs.legs[0].inertial.velocity_b)
        assert again.legs[0].observations.tobytes() == inputs.legs[0].observations.tobytes()


class TestRefusals:
    def refused(self, flown: Flown, request: InputOptions) -> str:
        with pytest.raises(UserError) as caught:
            read_inputs(flown.session(), request)
        assert "\n" not in caught.value.message
        return caught.value.message

    def test_unknown_device_names_are_refused(self, flown: Flown) -> None:
        assert self.refused(flown, InputOptions(imu="other")).endswith(
            "--imu: the configuration has no [imu.other]; it has: main"
        )
        assert "--gnss-name" in self.refused(flown, InputOptions(gnss="base"))

    def test_an_imu_without_data_is_refused(self, flown: Flown) -> None:
        config = flown.changed("other_wire.toml", **{"[imu.main": "[imu.second"})
        said = self.refused(flown, InputOptions(config=config))
        assert said.endswith("no samples of imu/second: the log has no byte of it; check that its wire is recorded")

    def test_a_receiver_of_another_protocol_is_refused(self, flown: Flown) -> None:
        config = flown.changed("nmea.toml", **{'protocol = "novatel"': 'protocol = "nmea"'})
        said = self.refused(flown, InputOptions(config=config))
        assert "no position of gnss/rover" in said
        assert "in no known message; set another protocol, or let the device send other messages" in said

    def test_a_log_without_its_configured_receiver_is_refused(self, flown: Flown) -> None:
        config = flown.changed("other_receiver.toml", **{"[gnss.rover]": "[gnss.away]"})
        assert "no position of gnss/away, and an IMU alone gives no trajectory: the log has no byte" in self.refused(
            flown, InputOptions(config=config)
        )

    def test_positions_of_another_day_are_refused(self, flown: Flown, tmp_path: Path) -> None:
        file = tmp_path / "ppk.pos"
        file.write_text(POS.format("2026/11/01"))
        assert "belongs to another flight" in self.refused(flown, InputOptions(positions=file))

    def test_a_finished_trajectory_is_refused_as_antenna_positions(self, flown: Flown, tmp_path: Path) -> None:
        file = tmp_path / "done.csv"
        file.write_text("gps_ns,lat_deg,lon_deg\n")
        assert "finished trajectory" in self.refused(flown, InputOptions(positions=file))
        assert "cannot be read" in self.refused(flown, InputOptions(positions=tmp_path / "none.pos"))

    def test_antennas_at_one_place_are_refused(self, flown: Flown) -> None:
        said = r"secondary_lever_arm_m: is 0\.00 m from lever_arm_m"
        with pytest.raises(ConfigError, match=said):
            flown.changed("one.toml", **{"[0.9, 0.6, -1.2]": "[0.1, -0.05, -1.2]"})
        rover = flown.config.gnss["rover"].model_copy(update={"secondary_lever_arm_m": [0.1, -0.05, -1.2]})
        tables = flown.config.tables.model_copy(update={"gnss": {"rover": rover}})
        config = Config(tables, flown.config.path, flown.config.text)  # as a log of an earlier version may have it
        assert "secondary_lever_arm_m: is 0.00 m from lever_arm_m" in self.refused(flown, InputOptions(config=config))


class TestWarnings:
    def test_a_baseline_that_differs_from_the_configured_one_gives_a_warning(self, flown: Flown) -> None:
        config = flown.changed("long.toml", **{"[0.9, 0.6, -1.2]": "[0.9, 1.6, -1.2]"})
        (line,) = read_inputs(flown.session(), InputOptions(config=config)).warnings
        assert "measures 1.03 m between its antennas" in line
        assert "are 1.83 m apart" in line

    def test_headings_without_a_second_antenna_give_a_warning(self, flown: Flown) -> None:
        config = flown.changed("single.toml", **{"secondary_lever_arm_m": "# "})
        inputs = read_inputs(flown.session(), InputOptions(config=config))
        assert inputs.observed["heading"] == 0
        assert inputs.refused["heading_no_secondary_lever_arm"] > 60
        assert "set gnss.rover.secondary_lever_arm_m" in inputs.warnings[0]

    def test_a_second_antenna_without_headings_gives_a_warning(self, tmp_path: Path) -> None:
        one = PLAN.replace("secondary_lever_arm_m = [0.9, 0.6, -1.2]", "")
        flown = fly_short(tmp_path, one, 10.0)
        assert not read_inputs(flown.session(), InputOptions()).warnings
        arm = "lever_arm_m = [0.1, -0.05, -1.2]"
        config = flown.changed("two.toml", **{arm: f"{arm}\nsecondary_lever_arm_m = [0.9, 0.6, -1.2]"})
        (line,) = read_inputs(flown.session(), InputOptions(config=config)).warnings
        assert "gnss/rover sent no heading that this program reads, although secondary_lever_arm_m" in line

    def test_an_imu_timed_by_arrival_gives_a_warning(self, flown: Flown) -> None:
        config = flown.changed("untimed.toml", **{"sample_ticks": "# ", "pps_ticks": "# ", 'group = "last"': ""})
        inputs = read_inputs(flown.session(), InputOptions(config=config))
        assert inputs.imu_time[0] == "arrival"
        assert "timed by their arrival" in inputs.warnings[0]
        assert inputs.setup.estimate_time_offset_s > 1e-3
        latched = read_inputs(flown.session(), InputOptions()).legs[0].inertial.time_ns
        off_ns = inputs.legs[0].inertial.time_ns[200:1200] - latched[200:1200]
        assert np.abs(off_ns - np.median(off_ns)).max() < 300_000
        assert abs(np.median(off_ns)) < 12_000_000  # a CAN frame may be late by an interval of 10 ms


POS = """% program   : RTKLIB
%  GPST latitude(deg) longitude(deg) height(m) Q ns sdn(m) sde(m) sdu(m) sdne(m) sdeu(m) sdun(m) age(s) ratio
{0} 09:00:20.000  47.482000000  8.905000000  700.0000  1 12  0.01 0.02 0.03  0.005 -0.006 0.007  0.00  9.9
{0} 09:00:20.200  47.482000000  8.905100000  700.0000  2 11  0.10 0.20 0.30  0.000  0.000 0.000  0.00  1.1
{0} 09:00:20.400  47.482000000  8.905200000  700.0000  7  4  0.10 0.20 0.30  0.000  0.000 0.000  0.00  1.1
"""


def test_positions_from_a_file_replace_those_of_the_receiver(flown: Flown, tmp_path: Path) -> None:
    file = tmp_path / "ppk.pos"
    file.write_text(POS.format("2026/06/15"))
    first = flown.truth().time_ns[0]
    inputs = read_inputs(flown.session(), InputOptions(positions=file))
    rows = inputs.legs[0].observations
    rows = rows[rows["kind"] == Kind.POSITION]
    assert rows["fix_type"].tolist() == [FixType.RTK_FIXED, FixType.RTK_FLOAT]
    assert rows["satellites"].tolist() == [12, 11]
    assert rows["sigma"][0].tolist() == [0.01, 0.02, 0.03]
    # covariances: 5² of 10·20, up is − down: −7² of 10·30, 6² of 20·30
    assert rows["correlation"][0] == pytest.approx([25 / 200, -49 / 300, 36 / 600])
    expected = Transformer.from_crs(4979, 4978, always_xy=True).transform(8.905, 47.482, 700.0)
    assert rows["value"][0] == pytest.approx(expected, abs=1e-6)
    week = 2423 * 604_800 * S  # of 2026-06-14; GPS time, as the file says
    assert rows["time_ns"].tolist() == [week + round((86_400 + 32_420 + at) * S) for at in (0.0, 0.2)]
    assert abs(int(rows["time_ns"][0]) - int(first)) < 30 * S
    assert inputs.refused["outside_fix_type"] == 1
    assert inputs.refused["fix_replaced_from_outside"] > 60
    assert inputs.observed["velocity"] > 60  # the file has none, so the receiver's stay


# ---------------------------------------------------------------------- records


def fix(**changes: Any) -> GnssFix:
    tag = TimeTag(TimeScale.GPS, 0, week=2423)
    usual = GnssFix(0, tag, 0.8, 0.1, 500.0, fix_type=FixType.RTK_FIXED, satellites=9, message="BESTPOS")
    return replace(usual, **changes)


class TestFixes:
    def test_messages_of_one_epoch_give_one_position_and_one_velocity(self) -> None:
        moving = {"lat_rad": None, "lon_rad": None, "height_m": None, "velocity_l": (1.0, 2.0, 3.0)}
        fixes = [fix(), fix(message="BESTVEL", **moving), fix(height_m=501.0), fix(fix_type=FixType.SINGLE)]
        found = fix_observations(fixes, [5, 5, 5, 5], 1)
        assert found.rows["kind"].tolist() == [Kind.POSITION, Kind.VELOCITY]
        assert found.rows["sigma"][0] == pytest.approx([0.02, 0.02, 0.04])  # of the first, whose fix is the best
        assert found.rows["value"][1].tolist() == [1.0, 2.0, 3.0]
        assert found.refused == {"repeated_in_epoch": 2}

    def test_the_better_fix_of_an_epoch_is_used_in_any_order(self) -> None:
        fixes = [fix(fix_type=FixType.SINGLE), fix(fix_type=FixType.RTK_FLOAT), fix(fix_type=FixType.DIFFERENTIAL)]
        found = fix_observations(fixes, [5, 5, 5], 1)
        assert found.rows["fix_type"].tolist() == [FixType.RTK_FLOAT]

    @pytest.mark.parametrize(
        ("changes", "at_ns", "why"),
        [
            ({"valid": False}, 5, "not_valid"),
            ({"fix_type": FixType.DEAD_RECKONING}, 5, "fix_type_dead_reckoning"),
            ({"fix_type": FixType.NONE}, 5, "fix_type_none"),
            ({}, None, "no_time"),
            ({"antenna": "secondary"}, 5, "no_lever_arm"),
            ({"height_m": None}, 5, "no_ellipsoidal_height"),
            ({"lat_rad": None, "height_m": None}, 5, "empty"),
            ({"height_m": float("nan")}, 5, "not_finite"),
        ],
    )
    def test_messages_that_are_not_observations_are_counted(
        self, changes: dict[str, Any], at_ns: int | None, why: str
    ) -> None:
        found = fix_observations([fix(**changes)], [at_ns], 1)
        assert (len(found.rows), dict(found.refused)) == (0, {why: 1})

    def test_satellite_positions_have_precedence_over_those_of_the_receivers_ins(self) -> None:
        found = fix_observations([fix(), fix(message="BESTGNSSPOS"), fix()], [5, 5, 6], 1)
        assert found.rows["time_ns"].tolist() == [5]
        assert found.refused == {"blended_by_ins": 2}

    @pytest.mark.parametrize("kind", sorted(DEFAULT_SIGMAS))
    def test_absent_sigmas_default_to_those_of_the_fix_type(self, kind: FixType) -> None:
        given = np.diag([0.5**2, np.nan, 0.0])
        found = fix_observations([fix(fix_type=kind, position_cov_l=given)], [5], 1)
        (horizontal, vertical), _ = DEFAULT_SIGMAS[kind]
        assert found.rows["sigma"][0].tolist() == [0.5, horizontal, vertical]
        assert found.assumed == {"position": 1}

    def test_a_covariance_is_converted_to_sigmas_and_correlations(self) -> None:
        given = np.array([[4.0, 1.2, -0.4], [1.2, 9.0, 0.6], [-0.4, 0.6, 16.0]])
        found = fix_observations([fix(position_cov_l=given)], [5], 1)
        assert found.rows["sigma"][0].tolist() == [2.0, 3.0, 4.0]
        assert found.rows["correlation"][0] == pytest.approx([0.2, -0.05, 0.05])
        assert not found.assumed


class TestHeadings:
    def heading(self, **changes: Any) -> GnssHeading:
        return replace(GnssHeading(100, TimeTag(TimeScale.GPS, 0), 1.0), **changes)

    def test_sigma_of_a_baseline_heading_follows_its_length(self) -> None:
        short, long = (heading_observations([self.heading()], [5], length).rows["sigma"][0, 0] for length in (0.5, 5.0))
        assert short / long == pytest.approx(10.0, rel=1e-3)
        said = heading_observations([self.heading(heading_sigma_rad=0.1)], [5], 1.0)
        assert said.rows["sigma"][0, 0] == 0.1
        assert np.isnan(said.rows["value"][0, 1])

    def test_a_heading_without_time_gets_that_of_the_fix_it_came_with(self) -> None:
        fixes = [fix(host_time_ns=at) for at in (0, S, 2 * S)]
        headings = [self.heading(time=None, host_time_ns=at) for at in (S + 100_000_000, 2 * S + 700_000_000)]
        assert heading_times(headings, [None, None], fixes, [10, 20, 30]) == [20, None]


@pytest.mark.parametrize(("step_s", "share", "tau_s"), [(5.0, 0.6, 60.0), (20.0, 1.0, 120.0), (1.0, 0.0, 60.0)])
def test_correlated_errors_average_as_slowly_as_white_ones_with_their_factor(
    step_s: float, share: float, tau_s: float
) -> None:
    """The variance of a mean of many is compared with that from the covariance of the errors themselves."""
    n = 4000
    apart = step_s * np.abs(np.subtract.outer(np.arange(n), np.arange(n)))
    covariance = share**2 * np.exp(-apart / tau_s) + (1 - share**2) * np.eye(n)
    assert white_factor(round(step_s * S), share, tau_s) ** 2 / n == pytest.approx(covariance.mean(), rel=0.02)


def test_each_heading_is_taken_once() -> None:
    """Headings may follow each other quickly, because the filter knows that their errors last."""
    headings = [GnssHeading(at, TimeTag(TimeScale.GPS, 0), 0.01 * at, heading_sigma_rad=2e-3) for at in range(60)]
    found = heading_observations([*headings, headings[7]], [at * 200_000_000 for at in [*range(60), 7]], 1.0)
    assert found.rows["time_ns"].tolist() == [at * 200_000_000 for at in range(60)]
    assert found.rows["value"][:, 0] == pytest.approx(0.01 * np.arange(60))
    assert found.rows["sigma"][:, 0] == pytest.approx(2e-3)
    assert found.refused == {"repeated_in_epoch": 1}


def test_attitudes_of_an_ins_are_few_and_only_of_valid_solutions() -> None:
    rows = np.zeros(250, INS_DTYPE)
    rows["gps_ns"] = 1000 * S + np.arange(250) * 200_000_000
    rows["heading_rad"], rows["attitude_sigma_rad"], rows["status"] = 1.5, np.nan, 3
    rows["status"][:100] = 1
    found = ins_observations(rows, lambda status: status == 3)
    assert found.rows["time_ns"].tolist() == [1020 * S, 1040 * S]
    assert set(found.rows["kind"]) == {Kind.ATTITUDE}
    assert found.rows["value"][0].tolist() == [0.0, 0.0, 1.5]
    assert found.refused == {"no_solution": 100}
    assert found.assumed == {"attitude": 2}


# ---------------------------------------------------------------------- times and noise


def test_arrivals_in_bunches_are_spread_evenly() -> None:
    """Reads take 16 ms, and samples are lost in a pause of two seconds."""
    true_ns = np.arange(2000) * 5_000_100
    true_ns = np.delete(true_ns, slice(1000, 1400))
    host_ns = (true_ns // 16_000_000 + 1) * 16_000_000
    found = counted_arrivals(host_ns, 200.0)
    off = found - (true_ns - true_ns[0])
    assert np.abs(off - np.median(off)).max() < 20_000_000
    assert np.diff(found)[:900].std() < 1.0


def test_samples_with_gps_time_need_no_clock() -> None:
    rows = np.zeros(3, IMU_DTYPE)
    rows["gps_week"], rows["device_time_ns"] = [2423, 2423, -1], [5, 7, 9]
    found = imu_times(rows, HostClocks(ClockPlan(0)), None, 100.0)
    assert found.gps_ns.tolist() == [2423 * 604_800 * S + 5, 2423 * 604_800 * S + 7]
    assert (found.by, found.refused) == ("gps", {"no_gps_week": 1})


def test_samples_before_any_time_are_counted() -> None:
    plan = ClockPlan(0, {"pps/main": PpsPlan()}, {"gnss/rover": GnssPlan("pps/main")})
    host = HostClocks(plan, keep_history=True)
    rows = np.zeros(10, IMU_DTYPE)
    rows["host_time_ns"] = rows["device_time_ns"] = np.arange(10) * 10_000_000
    rows["pps_time_ns"] = rows["gps_week"] = -1
    assert imu_times(rows, host, "pps/main", 100.0).refused == {"no_clock": 10}
    for second in range(20):
        host.add_edge("pps/main", PpsEdge(second * S, second))
        tag = TimeTag(TimeScale.GPS, (100 + second) * S, week=2423)
        host.add_message("gnss/rover", TimeMessage(second * S + 100_000_000, tag, NamesEdge.PREVIOUS, bound=True))
    host.update()
    found = imu_times(rows, host, "pps/main", 100.0)
    assert found.by == "counter"
    assert np.abs(found.gps_ns - 2423 * 604_800 * S - 100 * S - rows["host_time_ns"]).max() < 5_000_000


def test_noise_defaults_to_that_of_the_grade(flown: Flown) -> None:
    table = flown.config.imu["main"].noise.model_copy(
        update={"grade": "mems", "gyro_bias_deg_per_h": 3600.0, "accel_scale_ppm": 7.0}
        | dict.fromkeys(("angle_random_walk_deg_per_sqrt_h", "accel_bias_mg", "bias_correlation_h", "gyro_scale_ppm"))
        | {"velocity_random_walk_m_per_s_per_sqrt_h": 6.0, "misalignment_mrad": 0.25}
    )
    noise = noise_of(table)
    assert noise.gyro_bias == pytest.approx(radians(1.0))
    assert noise.accel_scale == pytest.approx(7e-6)
    assert noise.velocity_random_walk == pytest.approx(0.1)
    assert noise.misalignment == pytest.approx(2.5e-4)
    for name in ("angle_random_walk", "accel_bias", "bias_correlation_s", "gyro_scale"):
        assert getattr(noise, name) == getattr(GRADES["mems"], name)


def test_noise_keys_taken_from_a_grade_are_named(flown: Flown) -> None:
    """The keys have their own units; none is named if all are set, and a default grade is reported."""
    sources = NavigationSources(flown.config, {})
    keys = set(NoiseConfig.model_fields) - {"grade"}
    table = {"imu": {"main": sources.imu.model_copy(update={"noise": NoiseConfig(gyro_bias_deg_per_h=2.0)})}}
    bare = NavigationSources(without_scanners(flown.config, **table), {})
    assert set(bare.noise_by_grade) == keys - {"gyro_bias_deg_per_h"}
    assert bare.noise_by_grade["accel_bias_mg"] == 1.0
    assert bare.noise_by_grade["misalignment_mrad"] == 0.1
    assert bare.noise_by_grade["bias_correlation_h"] == 1.0
    assert bare.noise_words().startswith("Noise by grade tactical, the default (imu.main.noise does not set")
    every = NoiseConfig.model_validate({"grade": "mems"} | dict.fromkeys(keys, 1.0))
    table = {"imu": {"main": sources.imu.model_copy(update={"noise": every})}}
    whole = NavigationSources(without_scanners(flown.config, **table), {})
    assert (whole.noise_by_grade, whole.noise_words()) == ({}, "")


WAYPOINT = """Project:     rover
Program:     GrafNav

     Week     GPSTime        Latitude       Longitude       H-Ell  Q  NS  SDNorth  SDEast  SDHeight   VNorth
               (sec)      (+/-D M S)      (+/-D M S)         (m)              (m)     (m)       (m)    (m/s)
     2423  118820.00   47 28 55.20000   8 54 18.00000     700.000  1  12    0.010   0.011     0.020    1.000
     2423  118820.20   47 28 55.20000   8 54 18.00100     700.000  2  11    0.100   0.110     0.200    1.000
     2423  118820.40   47 28 55.20000   8 54 18.00200     700.000  6   5    1.000   1.100     2.000    1.000
"""


def test_waypoint_text_gives_its_quality() -> None:
    columns = read_antenna_positions(WAYPOINT.encode(), "rover.txt")
    assert columns.fix_type is not None
    assert columns.fix_type.tolist() == [FixType.RTK_FIXED, FixType.RTK_FLOAT, FixType.SINGLE]
    assert columns.satellites is not None
    assert columns.satellites.tolist() == [12, 11, 5]
    assert columns.position_sigma_l[2].tolist() == [1.0, 1.1, 2.0]
    assert np.degrees(columns.lat_rad[0]) == pytest.approx(47.482, abs=1e-9)


def test_positions_without_quality_are_as_accurate_as_their_sigmas(tmp_path: Path) -> None:
    """A floor for single receivers would make centimetres of post-processing half a metre."""
    lines = [line[:65] + line[68:] for line in WAYPOINT.splitlines()]
    assert " Q " in WAYPOINT
    assert " Q " not in "\n".join(lines)
    file = tmp_path / "ppk.txt"
    file.write_text("\n".join(lines) + "\n")
    begin_ns = (2423 * 604_800 + 118_820) * S
    rows = outside_observations(file, (begin_ns, begin_ns + S), None, 18).observed.rows
    rows = rows[rows["kind"] == Kind.POSITION]
    assert rows["fix_type"].tolist() == [FixType.RTK_FIXED, FixType.RTK_FLOAT, FixType.SINGLE]
    assert rows["sigma"][0].tolist() == [0.010, 0.011, 0.020]


# ---------------------------------------------------------------------- heights that may be above the geoid


def gga_fixes(separations_m: list[float]) -> list[GnssFix]:
    """Return fixes of a receiver in the Alps, from a GGA each second with the given geoid separation, m."""
    sentences = [
        encode_gga((36_000 + second) * S, 0.82, 0.16, 850.0, separation_m, quality=4, satellites=14)
        for second, separation_m in enumerate(separations_m)
    ]
    fixes = [
        record
        for record in feed_pieces(NmeaParser(DeviceSettings("gnss/rover")), sentences)
        if isinstance(record, GnssFix)
    ]
    assert len(fixes) > 10
    return fixes


def findings_of(fixes: list[GnssFix]) -> list[Finding]:
    found: Any = SimpleNamespace(fixes=fixes)
    sources: Any = SimpleNamespace(gnss_source="gnss/rover")
    return height_findings(found, sources)


def test_a_geoid_separation_of_zero_in_every_gga_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    fixes = gga_fixes([0.0] * 20)
    assert {fix.undulation_m for fix in fixes} == {0.0}
    for known, size in ((None, "up to 107 m"), ((48.2, "EGM2008"), "48.2 m (EGM2008)")):
        monkeypatch.setattr(input_checks, "geoid_undulation", lambda place, known=known: known)
        (finding,) = findings_of(fixes)
        assert finding.severity == "warning"
        assert (
            f"heights are wrong by the geoid's height, {size}; let the receiver send its geoid separation"
            in finding.text
        )


def test_a_real_geoid_separation_is_not_reported() -> None:
    assert not findings_of(gga_fixes([48.0] * 20))
    assert not findings_of(gga_fixes([0.1, 0.0, -0.1] * 8))
    assert not findings_of(gga_fixes([0.0] * 20)[:5])  # too few to say


def test_a_log_whose_receiver_lacks_a_geoid_has_the_finding(tmp_path: Path) -> None:
    plan = PLAN.replace("[gnss.rover]\nrate_hz = 5\nsecondary_lever_arm_m = [0.9, 0.6, -1.2]", NMEA)
    assert NMEA in plan
    inputs = read_inputs(fly_short(tmp_path, plan, 10.0).session(), InputOptions())
    assert [finding.code for finding in inputs.findings] == ["geoid_unsaid"]


# ---------------------------------------------------------------------- positions from outside, whole seconds away


def flown_rows(later_s: float = 0.0, north_m: float = 0.0) -> StructArray:
    """Return positions twice a second of a turning flight at 50 m/s, late by `later_s` or displaced by `north_m`."""
    second = np.arange(0.0, 120.0, 0.5)
    rows = np.zeros(len(second), OBSERVATION_DTYPE)
    rows["kind"], rows["time_ns"] = Kind.POSITION, np.rint(1e9 * (1e9 + second + later_s)).astype(np.int64)
    rows["value"] = 800.0 * np.stack([np.sin(second / 16.0), np.cos(second / 16.0), 0.0 * second], axis=1)
    rows["value"][:, 0] += north_m
    return rows


@pytest.mark.parametrize(("later_s", "words"), [(2.0, "2 s later"), (-18.0, "18 s earlier"), (37.0, "37 s later")])
def test_positions_written_with_other_leap_seconds_are_reported(later_s: float, words: str) -> None:
    outside = OutsidePositions(Path("a.pos"), Observed(flown_rows(later_s), Counter(), Counter()))
    with pytest.raises(UserError, match=f"a.pos: its positions are those of the log's receiver {words} .*leap seconds"):
        refuse_shifted(outside, flown_rows())


@pytest.mark.parametrize(("later_s", "north_m"), [(0.0, 0.0), (0.02, 0.0), (0.0, 3.0), (0.0, 300.0)])
def test_positions_of_the_same_time_or_another_place_are_not_reported_as_shifted(
    later_s: float, north_m: float
) -> None:
    outside = OutsidePositions(Path("a.pos"), Observed(flown_rows(later_s, north_m), Counter(), Counter()))
    refuse_shifted(outside, flown_rows())
    refuse_shifted(outside, flown_rows()[:3])


@pytest.mark.parametrize(("protocol", "remedy"), [("xsens-mti", "; let the IMU latch PPS edges"), ("records", "")])
def test_uncertain_times_are_told_with_what_would_help(protocol: str, remedy: str) -> None:
    imu = SimpleNamespace(protocol=protocol)
    sources: Any = SimpleNamespace(imu=imu, imu_source="imu/main", gnss_source="gnss/rover")
    times: Any = SimpleNamespace(by="counter", sigma_s=0.0042)
    assert input_checks.time_doubts(sources, times, Path("a.mcap")) == [
        f"a.mcap: the times of imu/main are good to 4.2 ms only, so the filter estimates an offset{remedy}"
    ]
