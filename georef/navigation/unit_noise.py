"""Check whether a flight requires another noise of its inertial unit than it was navigated with.

Setups are compared by the likelihood of the same innovations, with GNSS's scales matched for each (`noise`). Another
noise is reported only if ln likelihood is better by `SIGNIFICANT`. A unit that is quieter than stated shows in the same
way.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

from swath.georef.navigation.diagnosis.data import Finding
from swath.georef.navigation.inputs import ImuNoise, Setup
from swath.georef.navigation.noise import SIGNIFICANT, Judged, Run

LARGER = 5.0  # factor on a sensor's errors that is tried
LEAST = {"gyro_scale": 1e-3, "accel_scale": 1e-3, "misalignment": 1e-3}  # least sigmas that are tried
KEYS = {"gyro_scale": "gyro_scale_ppm", "accel_scale": "accel_scale_ppm", "misalignment": "misalignment_mrad"}
IN_KEY = {"gyro_scale": 1e6, "accel_scale": 1e6, "misalignment": 1e3}


@dataclass(frozen=True)
class Asked:
    """Another noise that a flight requires.

    Attributes:
        name: of the grade, or of the field of `ImuNoise`.
        noise: the noise.
        gain: its gain of ln likelihood.
    """

    name: str
    noise: ImuNoise
    gain: float


def better_grade(run: Run, setup: Setup, grades: Mapping[str, ImuNoise]) -> Asked | None:
    """Return the grade that innovations fit best; None if none fits better than the setup's noise.

    Args:
        run: returns the innovations of a run over a part of the flight with a setup.
        setup: of the flight, GNSS's noise found.
        grades: others, by name.
    """
    judged = Judged(run)
    known = judged.matched(setup).log_likelihood
    asked = [
        Asked(name, noise, judged.matched(replace(setup, noise=noise)).log_likelihood - known)
        for name, noise in grades.items()
        if noise != setup.noise
    ]
    best = max(asked, key=lambda one: one.gain, default=None)
    return best if best is not None and best.gain > SIGNIFICANT else None


def contradicted(run: Run, setup: Setup) -> list[Asked]:
    """Return scale factors and misalignments that the flight shows to be larger than in the setup's noise.

    Args: as of `better_grade`.
    """
    larger = {name: max(LARGER * getattr(setup.noise, name), least) for name, least in LEAST.items()}
    judged = Judged(run)
    known = judged.matched(setup).log_likelihood
    together = replace(setup, noise=replace(setup.noise, **larger))
    if judged.matched(together).log_likelihood - known <= SIGNIFICANT:
        return []
    found = []
    for name, sigma in larger.items():
        noise = replace(setup.noise, **{name: sigma})
        gain = judged.matched(replace(setup, noise=noise)).log_likelihood - known
        if gain > SIGNIFICANT:
            found.append(Asked(name, noise, gain))
    return sorted(found, key=lambda one: -one.gain)


def noise_findings(run: Run, setup: Setup, grade: str, grades: Mapping[str, ImuNoise], table: str) -> Iterator[Finding]:
    """Yield the findings of `better_grade` and `contradicted`.

    Args:
        run, setup, grades: as of `better_grade`.
        grade: the configured grade of the setup's noise.
        table: ``imu.main.noise``, the table of its keys.
    """
    better = better_grade(run, setup, {name: noise for name, noise in grades.items() if name != grade})
    if better is not None:
        yield Finding(
            "imu_grade",
            "warning",
            f"innovations fit grade {better.name} better than {grade} (ln likelihood +{better.gain:.0f}): set "
            f'{table}.grade = "{better.name}", or the figures of the data sheet',
        )
        return
    for asked in contradicted(run, setup):
        key, factor = KEYS[asked.name], IN_KEY[asked.name]
        configured, tried = factor * getattr(setup.noise, asked.name), factor * getattr(asked.noise, asked.name)
        yield Finding(
            "imu_noise",
            "warning",
            f"the flight contradicts {key} = {configured:g}: {tried:g} fits better (ln likelihood "
            f"+{asked.gain:.0f}); set {table}.{key} larger, or calibrate the unit",
        )
