"""What `swath calibrate` is asked to estimate, from its options."""

from __future__ import annotations

from calib.parameters import Wish
from daemon.errors import ExitCode, UserError
from georef.calibration import PARAMETERS


def model_of(model: str, fix: str, free: str, priors: list[str]) -> Wish:
    """Keys of a calibration file, as ``phi_deg`` or ``left.phi_deg``, to what the adjustment takes.

    Raises:
        UserError: one is no parameter, or a sigma is none.
    """
    sigmas: dict[str, float] = {}
    for entry in priors:
        key, _, value = entry.partition("=")
        try:
            sigma = float(value)
        except ValueError:
            raise UserError(f'--prior {entry}: want KEY=SIGMA, as "phi_deg=0.01"', ExitCode.USAGE) from None
        name, factor = _name_of(key, "--prior")
        sigmas[name] = sigma * factor
    named = {
        option: frozenset(_name_of(key, option)[0] for key in text.split(",") if key)
        for option, text in (("--fix", fix), ("--free", free))
    }
    return Wish(model, named["--fix"], named["--free"], sigmas)


def _name_of(key: str, option: str) -> tuple[str, float]:
    """The model's name of a key, and SI a unit of the key."""
    scanner, dot, bare = key.strip().rpartition(".")
    for parameter in PARAMETERS:
        if bare in (parameter.key, parameter.name):
            return f"{scanner}{dot}{parameter.name}", parameter.factor if bare == parameter.key else 1.0
    keys = ", ".join(parameter.key for parameter in PARAMETERS)
    raise UserError(f"{option} {key}: is no parameter; want one of {keys}", ExitCode.USAGE)
