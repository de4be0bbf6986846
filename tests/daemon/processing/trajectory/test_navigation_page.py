"""Tests the page of a navigated flight: it is complete, and no event between two pixels is lost."""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from html.parser import HTMLParser
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from pyproj import Transformer

from swath.daemon.processing.trajectory.page import PICTURES, make_page
from swath.daemon.processing.trajectory.panels import NARROW, WIDE, Drawn
from swath.daemon.processing.trajectory.pictures import FATE_LOOK, FIX_LOOK, draw_innovations, draw_map
from swath.daemon.processing.trajectory.series import (
    COLUMNS,
    Flight,
    Pixels,
    bridged_spans,
    course_of,
    fix_types_at,
    outages_of,
    separation_of,
)
from swath.georef.navigation.inputs import Fate, Kind, Solution
from swath.georef.records import FixType
from swath.georef.timescales.gps_time import SECOND_NS
from tests.daemon.navigation_flights import reference_truth, sound_flight, with_rows
from tests.daemon.processing.pages.builders import faults_of

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("kernels")]

Array = NDArray[Any]
EVERY = 4
OUTAGE_S = 600, 640


@pytest.fixture(scope="module")
def flight() -> Flight:
    """Return a flight with an outage, rejected positions, several fix types, a spike and bridged samples."""
    sound = sound_flight(every=EVERY)
    rows = sound.forward.innovations.copy()
    at_s = (rows["time_ns"] - rows["time_ns"][0]) / SECOND_NS
    rows["fix_type"][at_s > 1000] = FixType.RTK_FLOAT
    rows["fate"][200:260:4], rows["normalised"][200:260:4] = Fate.REJECTED, 30.0
    rows = rows[(at_s <= OUTAGE_S[0]) | (at_s >= OUTAGE_S[1])]
    troubled = with_rows(sound, rows)
    setup = replace(sound.setup, estimate_lever_arm=0.3, estimate_time_offset_s=0.2)
    bridged = np.zeros(len(sound.forward), bool)
    bridged[1000:1010] = True
    assert troubled.smoothed is not None
    return replace(
        troubled, title="<b>log & name</b>", smoothed=replace(troubled.smoothed, bridged=bridged), setup=setup
    )


@dataclass
class Page(HTMLParser):
    """What a page shows: attributes that name other things, text, and how many tables."""

    sources: list[tuple[str, str]] = field(default_factory=list)
    words: list[str] = field(default_factory=list)
    tags: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        super().__init__()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.sources += [(tag, value or "") for name, value in attrs if name in {"src", "srcset", "href"}]

    def handle_data(self, data: str) -> None:
        self.words.append(data)


def image_of(source: str) -> Image.Image:
    head, _, data = source.partition(",")
    assert head == "data:image/png;base64"
    return Image.open(io.BytesIO(base64.b64decode(data)))


def test_the_page_is_complete(flight: Flight) -> None:
    text, verdict, _ = make_page(flight)
    page = Page()
    page.feed(text)
    assert len(text.encode()) < 3_000_000
    assert "<b>log" not in text
    assert faults_of(text) == []
    assert "http" not in text
    assert not {"script", "link", "iframe"} & set(page.tags)
    words = "".join(page.words).replace("\xa0", " ")  # between a number and its unit
    assert verdict.sentence in words
    assert all(reason.what in words and reason.change in words for reason in verdict.reasons)
    for told in ("GPS week 2376", "static alignment over 140 s", "RTK float", "1\u202f787", "gyro bias x"):
        assert told in words, told
    titles = [title for title, *_ in PICTURES]
    assert all(title in words for title in titles)
    sizes = [image_of(source).size for tag, source in page.sources if tag == "img"]
    narrow = [image_of(source).size for tag, source in page.sources if tag == "source"]
    assert len(sizes) == len(narrow) == len(titles)
    assert {width for width, _ in sizes} == {int(WIDE.width_in * WIDE.dpi + 1e-6)}
    assert {width for width, _ in narrow} == {int(NARROW.width_in * NARROW.dpi + 1e-6)}


def test_a_minimal_solution_gives_a_page(flight: Flight) -> None:
    """It has three epochs, no observation, no node, and no smoothing."""
    first: dict[str, Any] = {}
    for name in Solution.__dataclass_fields__:
        value = getattr(flight.forward, name)
        if isinstance(value, np.ndarray):
            first[name] = value[: 3 if len(value) == len(flight.forward) else 0]
    little = replace(flight, forward=replace(flight.forward, **first), smoothed=None)
    text, verdict, figures = make_page(little)
    assert verdict.sentence.startswith("Not to be used: the filter used only 0 positions")
    assert figures["observations"] == {}
    assert "Filter − smoother" not in text


def test_a_spike_of_one_epoch_is_drawn(flight: Flight) -> None:
    time_ns = 1_000_000_000_000 + np.arange(3_600_000, dtype=np.int64) * 5_000_000
    values = np.zeros(len(time_ns))
    values[1_234_567], values[2_345_678] = 7.0, -5.0
    pixels = Pixels(time_ns, int(time_ns[0]))
    assert len(pixels) == COLUMNS
    at_s, line = pixels.line(pixels.band(values))
    assert (line.max(), line.min()) == (7.0, -5.0)
    assert at_s[np.argmax(line)] == pytest.approx(1_234_567 * 0.005, abs=18.0 / 2)  # half of a column
    assert not np.isnan(line).any()


def test_few_samples_are_drawn_unreduced() -> None:
    time_ns = np.array([0, 1, 2, 3, 10, 11, 12], np.int64) * SECOND_NS
    pixels = Pixels(time_ns, 0)
    at_s, line = pixels.line(pixels.band(np.arange(7.0)))
    assert np.array_equal(at_s[::2], [0, 1, 2, 3, np.nan, 10, 11, 12], equal_nan=True)
    assert np.array_equal(line[::2], [0, 1, 2, 3, np.nan, 4, 5, 6], equal_nan=True)


def test_blocks_cover_every_sample_once(flight: Flight) -> None:
    pixels = Pixels(flight.best.time_ns, flight.start_ns)
    blocks = list(pixels.blocks(700))
    assert len(blocks) > 5
    assert np.array_equal(np.concatenate([np.arange(p.start, p.stop) for _, p in blocks]), np.arange(len(flight.best)))
    assert np.array_equal(np.concatenate([np.arange(c.start, c.stop) for c, _ in blocks]), np.arange(len(pixels)))


def test_drawn_errors_match_the_truth_of_the_flight() -> None:
    """The stand-in's errors are 5 mm, 5 mm/s, 0.004°; bands contain the truth within six sigmas of these."""
    flight = sound_flight(every=1)  # 20 Hz: epochs are close enough to share verticals
    truth = reference_truth()
    course = course_of(flight)
    speed = np.hypot(truth[:, 5], truth[:, 6])
    angles = truth[:, 8:11].copy()
    for values, band, sigma in (
        (truth[:, 4], course.height_m, 0.005),
        (speed, course.speed_mps, 0.006),
        (-truth[:, 7], course.climb_mps, 0.005),
        (angles[:, 0], course.attitude_deg[..., 0], 0.002),
        (angles[:, 1], course.attitude_deg[..., 1], 0.002),
    ):
        low, high = course.pixels.band(values)
        assert (np.abs(band[0] - low) < 6 * sigma).all()
        assert (np.abs(band[1] - high) < 6 * sigma).all()
    middle = course.attitude_deg[..., 2].mean(axis=0)
    starts = course.pixels.starts
    turned = (middle - np.degrees(np.unwrap(np.radians(angles[:, 2])))[starts] + 180) % 360 - 180
    turning = np.diff(course.attitude_deg[..., 2], axis=0)[0]
    assert (np.abs(turned) < turning + 0.03).all()
    assert (middle >= 0).all()
    assert (middle < 360).all()
    back = Transformer.from_crs("EPSG:32632", "EPSG:4326", always_xy=True)
    lon, lat = back.transform(*course.place)
    assert lon == pytest.approx(np.interp(course.place_ns, flight.best.time_ns, truth[:, 3]), abs=1e-6)
    assert lat == pytest.approx(np.interp(course.place_ns, flight.best.time_ns, truth[:, 2]), abs=1e-6)


@pytest.mark.parametrize("every", [1, 40])
def test_shared_verticals_make_no_difference(every: int) -> None:
    """At 20 Hz sixteen epochs share a vertical, at 0.5 Hz each has its own."""
    flight = sound_flight(every=every)
    course, trajectory = course_of(flight), flight.best.trajectory()
    roll, pitch, _ = trajectory.attitude()
    for values, band, within in (
        (trajectory.geodetic()[2], course.height_m, 1e-3),
        (np.degrees(roll), course.attitude_deg[..., 0], 1e-3),
        (np.degrees(pitch), course.attitude_deg[..., 1], 1e-3),
        (-trajectory.velocity_l()[:, 2], course.climb_mps, 1e-3),
    ):
        assert band == pytest.approx(course.pixels.band(values), abs=within)


def test_outages_bridges_and_fix_types_are_found(flight: Flight) -> None:
    zero_ns = int(flight.forward.innovations["time_ns"][0])
    (outage_ns,) = outages_of(flight)
    assert tuple((outage_ns - zero_ns) / SECOND_NS) == pytest.approx((OUTAGE_S[0], OUTAGE_S[1]), abs=1e-9)
    asked = zero_ns + np.array([-1.0, 0.0, 599.5, 601.0, 641.0, 1000.5, 1001.0]) * SECOND_NS
    types = fix_types_at(flight, asked.astype(np.int64))
    fixed, floated = FixType.RTK_FIXED, FixType.RTK_FLOAT
    assert types.tolist() == [fixed, fixed, fixed, -1, fixed, fixed, floated]
    ((begin_ns, end_ns),) = bridged_spans(flight.best)
    assert (begin_ns, end_ns) == (flight.best.time_ns[999], flight.best.time_ns[1009])


def test_separation_is_filter_minus_smoother_in_l(flight: Flight) -> None:
    """A step put into the filter appears in north, east, down, with the sigma of the difference."""
    assert flight.smoothed is not None
    separation = separation_of(replace(flight, forward=flight.smoothed))
    assert separation is not None
    assert np.abs(separation.position_m).max() == 0.0
    assert np.isnan(separation.position_sigma_m).all()
    truth = reference_truth()[::EVERY]
    lat, lon = np.radians(truth[:, 2]), np.radians(truth[:, 3])
    north_e = np.stack([-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)], axis=1)
    moved = replace(flight.smoothed, position_e=flight.smoothed.position_e + 0.25 * north_e)
    separation = separation_of(replace(flight, forward=moved))
    assert separation is not None
    assert separation.position_m == pytest.approx(np.tile([0.25, 0.0, 0.0], (len(truth), 1)), abs=1e-6)
    separation = separation_of(flight)
    assert separation is not None
    assert separation.position_sigma_m[0] == pytest.approx(
        [np.sqrt(0.008**2 - 0.003**2), np.sqrt(0.007**2 - 0.003**2), np.sqrt(0.011**2 - 0.005**2)]
    )


def pixels_near(png: bytes, colour: str) -> int:
    """Return how many pixels nearly have a colour."""
    image = np.asarray(Image.open(io.BytesIO(png)).convert("RGB")).astype(int)
    wanted = np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)])
    return int((np.abs(image - wanted).max(axis=2) < 24).sum())


def test_pictures_show_rejections_and_fix_types(flight: Flight) -> None:
    sound = sound_flight(every=40)
    clean = Drawn(sound, course_of(sound), None)
    drawn = Drawn(flight, course_of(flight), None)
    red, amber = FATE_LOOK[Fate.REJECTED][1], FIX_LOOK[FixType.RTK_FLOAT][0]
    seen: Mapping[str, int] = {
        "rejected": pixels_near(draw_innovations(drawn, WIDE), red),
        "none rejected": pixels_near(draw_innovations(clean, WIDE), red),
        "float": pixels_near(draw_map(drawn, NARROW), amber),
        "no float": pixels_near(draw_map(clean, NARROW), amber),
    }
    assert seen["rejected"] > 60
    assert seen["float"] > 300
    assert seen["none rejected"] == seen["no float"] == 0


def test_a_flight_with_positions_only_is_drawn(flight: Flight) -> None:
    rows = flight.forward.innovations
    assert set(np.unique(rows["kind"])) == {Kind.POSITION, Kind.VELOCITY}
    assert outages_of(with_rows(flight, rows[rows["kind"] == Kind.VELOCITY])).shape == (1, 2)
