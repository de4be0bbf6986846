"""The error model as plain values, which are written as JSON and read back to the bit."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from swath.georef.arrays import FloatArray
from swath.georef.error_model.correlation import Correlation
from swath.georef.error_model.model import AXES, GROUPS, OFFSETS, ErrorModel, ErrorModelError, Unit

FORMAT, VERSION = "swath error model", 1
UPPER = np.triu_indices(6)
UPPER_3 = np.triu_indices(3)


def state_of(model: ErrorModel) -> dict[str, Any]:
    """Return a model as values of JSON."""
    return {
        "format": FORMAT,
        "version": VERSION,
        "correlation_in_time": {
            group: _correlation(one) for group, one in zip(GROUPS, model.correlations, strict=True)
        },
        "units": [_unit(unit) for unit in model.units],
    }


def model_of_state(state: Mapping[str, Any]) -> ErrorModel:
    """Return the model of a state.

    Raises:
        ErrorModelError: the state is none, or of another version; one line.
    """
    if state.get("format") != FORMAT or state.get("version") != VERSION:
        found = f"{state.get('format')!r}, version {state.get('version')!r}"
        raise ErrorModelError(f"is {found}; this program reads {FORMAT!r}, version {VERSION}")
    try:
        in_time = [_read_correlation(state["correlation_in_time"][group]) for group in GROUPS]
        return ErrorModel([_read_unit(unit) for unit in state["units"]], in_time)
    except ErrorModelError:
        raise
    except KeyError as error:
        raise ErrorModelError(f"lacks {error.args[0]!r}; write it again with swath georef --error-model") from error
    except (TypeError, ValueError, AttributeError) as error:
        raise ErrorModelError(f"has a wrong value: {error}; write it again with swath georef --error-model") from error


def _correlation(one: Correlation) -> dict[str, float]:
    return {"a": one.a, "alpha": one.alpha, "beta": one.beta, "tau": one.tau}


def _read_correlation(value: Mapping[str, Any]) -> Correlation:
    return Correlation(float(value["a"]), float(value["alpha"]), float(value["beta"]), float(value["tau"]))


def _unit(unit: Unit) -> dict[str, Any]:
    return {
        "strip": unit.strip,
        "scanner": unit.scanner,
        "start_gps_ns": unit.start_ns,
        "end_gps_ns": unit.end_ns,
        "azimuth_rad": unit.azimuth_rad,
        "posts": {
            "gps_ns": unit.post_ns.tolist(),
            "position_m": unit.position_m.tolist(),
            "covariance": unit.covariance[:, UPPER[0], UPPER[1]].tolist(),
        },
        "calibration": unit.calibration.tolist(),
        "unmodelled": {
            "covariance_m2": unit.unmodelled[UPPER_3].tolist(),
            "correlation": {
                axis: _correlation(one) for axis, one in zip(AXES, unit.unmodelled_correlation, strict=True)
            },
        },
        "noise": unit.noise.tolist(),
    }


def _read_unit(value: Mapping[str, Any]) -> Unit:
    posts, unmodelled = value["posts"], value["unmodelled"]
    times = np.array(posts["gps_ns"], np.int64)
    covariance = np.zeros((len(times), 6, 6))
    covariance[:, UPPER[0], UPPER[1]] = _finite(posts["covariance"], (len(times), len(UPPER[0])))
    covariance = covariance + np.triu(covariance, 1).transpose(0, 2, 1)
    space = np.zeros((3, 3))
    space[UPPER_3] = _finite(unmodelled["covariance_m2"], (6,))
    u, v, w = (_read_correlation(unmodelled["correlation"][axis]) for axis in AXES)
    calibration = value["calibration"]
    if (np.diff(times) <= 0).any():
        raise ValueError(f"the posts of strip {value['strip']} are not in the order of their times")
    return Unit(
        int(value["strip"]),
        str(value["scanner"]),
        int(value["start_gps_ns"]),
        int(value["end_gps_ns"]),
        float(value["azimuth_rad"]),
        times,
        _finite(posts["position_m"], (len(times), 3)),
        covariance,
        _finite(calibration, (len(calibration), OFFSETS)),
        space + np.triu(space, 1).T,
        (u, v, w),
        _finite(value["noise"], (3,)),
    )


def _finite(values: Any, shape: tuple[int, ...]) -> FloatArray:
    array = np.array(values, np.float64).reshape(shape)
    if not np.isfinite(array).all():
        raise ValueError("a number is not finite")
    return array
