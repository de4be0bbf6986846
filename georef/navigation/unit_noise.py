"""Whether a flight asks for another noise of its inertial unit than it was navigated with.

Setups are compared by the likelihood of the same innovations, GNSS's scales matched for each (`noise`). Another noise
is named only where ln likelihood is better by `SIGNIFICANT`. A unit that is quieter than said shows likewise.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

from swath.georef.navigation.diagnosis.data import Finding
from swath.georef.navigation.inputs import ImuNoise, Setup
from swath.georef.navigation.noise import SIGNIFICANT, Judged, Run

LARGER = 5.0  # times as large errors of a sensor are tried
LEAST = {"gyro_scale": 1e-3, "accel_scale": 1e-3, "misalignment": 1e-3}  # that is tried at least
KEYS = {"gyro_scale": "gyro_scale_ppm", "accel_scale": "accel_scale_ppm", "misalignment": "misalignment_mrad"}
IN_KEY = {"gyro_scale": 1e6, "accel_scale": 1e6, "misalignment": 1e3}


@dataclass(frozen=True)
class Asked:
    """Another noise.

    Attributes:
        name: of the grade, or of the field of `ImuNoise`.
        noise: it.
        gain: ln likelihood that it wins.
    """

    name: str
    noise: ImuNoise
    gain: float


def better_grade(run: Run, setup: Setup, grades: Mapping[str, ImuNoise]) -> Asked | None:
    """Return the grade that innovations fit best, where that is better than the setup's noise; None where none is.

    Args:
        run: gives the innovations of a run over a part of the flight with a setup.
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
    """Return scale factors and misalignments that the flight shows to be larger than the setup's noise has them.

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
    """Say what `better_grade` and `contradicted` find.

    Args:
        grade: of the configuration, with whose name the setup's noise goes.
        table: ``imu.main.noise``, where its keys are.
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
        said, tried = factor * getattr(setup.noise, asked.name), factor * getattr(asked.noise, asked.name)
        yield Finding(
            "imu_noise",
            "warning",
            f"the flight contradicts {key} = {said:g}: {tried:g} fits better (ln likelihood +{asked.gain:.0f}); set "
            f"{table}.{key} larger, or calibrate the unit",
        )
