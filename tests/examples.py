"""Makes the example PDFs in docs/examples anew, all of virtual flights.

python -m tests.examples [FOLDER]     FOLDER keeps flights, pages and pictures; flights that it has are not flown again

The flights: one that calibrates, one that is surveyed and one of a single strip. Bad examples have the nominal
calibration, or a pitch that was held where it is wrong.
"""

from __future__ import annotations

import datetime as dt
import io
import shutil
import sys
import tempfile
from pathlib import Path

import numpy as np
from pypdf import PdfReader, PdfWriter

from tests.office import ROOT, run

EXAMPLES = ROOT / "docs" / "examples"
LARGE, QUALITY = 900_000, 70  # bytes of a PDF whose pictures become JPEG, and their quality
FLIGHTS = {
    "calibration": "swath sim fly small -o calibration --seed 2",
    "survey": "swath sim fly small -o survey --seed 1",
    "single": "swath sim fly small -o single --seed 1 --seconds 30",
}
TRAJECTORIES = [
    "swath trajectory calibration -o nav/calibration",
    "swath trajectory survey -o nav/survey",
    "swath trajectory survey -o nav/realtime --realtime",
    "swath trajectory single -o nav/single",
]
GOOD = [
    "swath calibrate calibration -o left.toml --trajectory nav/calibration/*.sbet --control calibration/control.csv "
    "--report report",
    "swath validate left.toml survey --trajectory nav/survey/*.sbet --control survey/control.csv -o validation",
    "swath georef survey -o three-strips --trajectory nav/survey/*.sbet --calibration left.toml",
    "swath strips three-strips -o strips",
    "swath view three-strips",
    "swath georef single -o one-strip --trajectory nav/single/*.sbet --calibration left.toml",
    "swath view one-strip",
    "swath history history/stays -o history/stays",
    "swath plan-calibration calibration -o plan.html",
]
BAD = [
    "swath calibrate survey -o held.toml --trajectory nav/survey/*.sbet --fix phi_deg --report held",
    "swath validate survey/left.nominal.toml survey --trajectory nav/survey/*.sbet --control survey/control.csv "
    "-o nominal-validation",
    "swath georef survey -o nominal --trajectory nav/survey/*.sbet --calibration survey/left.nominal.toml",
    "swath strips nominal -o nominal-strips",
    "swath view nominal",
    "swath history history/knocked -o history/knocked",
    "swath plan-calibration small --no-control -o too-short.html",
]
PAGES = {
    "calibration": "report/report.pdf",
    "calibration-pitch-held": "held/report.pdf",
    "history": "history/stays/history.pdf",
    "history-knocked": "history/knocked/history.pdf",
    "plan": "plan.pdf",
    "plan-too-short": "too-short.pdf",
    "quick-look": "three-strips/view/index.pdf",
    "quick-look-one-strip": "one-strip/view/index.pdf",
    "strips": "strips/strips.pdf",
    "strips-nominal-calibration": "nominal-strips/strips.pdf",
    "trajectory": "nav/survey/*_trajectory.pdf",
    "trajectory-real-time": "nav/realtime/*_trajectory.pdf",
    "validation": "validation/validation.pdf",
    "validation-nominal-calibration": "nominal-validation/validation.pdf",
}
FLOWN = ((1, 14), (3, 9), (4, 22), (6, 15), (8, 3), (9, 18))  # months and days of 2026
VALUES = {  # true value, sigma, change by a knock before the third, and by the new mounting before the fifth
    "omega_deg": (0.2513, 0.004, 0.036, -0.172),
    "phi_deg": (-0.4021, 0.005, 0.0, 0.0),
    "kappa_deg": (0.6110, 0.008, 0.0, 0.175),
    "range_offset_m": (0.35, 0.012, 0.0, 0.0),
    "scan_plane_tilt_deg": (0.0, 0.006, 0.0, 0.0),
}
LEVER_ARM = "lever_arm_x_m = 0.12\nlever_arm_y_m = -0.03\nlever_arm_z_m = 0.28\n"


def write_calibrations(folder: Path, *, knocked: bool) -> None:
    """Write six calibrations of a year, all of one mounting, or of one that was knocked and then mounted anew."""
    folder.mkdir(parents=True, exist_ok=True)
    drawn = np.random.default_rng(7)
    for number, (month, day) in enumerate(FLOWN):
        flown = dt.datetime(2026, month, day, 9, 30, tzinfo=dt.UTC)
        mounting = "HB-ABC/left/2026-08" if knocked and number >= 4 else "HB-ABC/left/2026-01"
        head = (
            f'[calibration]\nid = "{flown:%Y-%m-%d}"\nscanner = "left"\n'
            f"created = {flown + dt.timedelta(days=1):%Y-%m-%dT%H:%M:%SZ}\nflown = {flown:%Y-%m-%dT%H:%M:%SZ}\n"
            f'conventions = 1\nmethod = "combined"\nverdict = "good"\n'
            f'scanner_model = "VQ-780"\nscanner_serial = "S2221234"\ninstallation = "{mounting}"\n'
        )
        found = {
            key: true + knocked * ((number >= 2) * knock + (number >= 4) * (anew - knock)) + sigma * drawn.normal()
            for key, (true, sigma, knock, anew) in VALUES.items()
        }
        parameters = "".join(f"{key} = {value:.6f}\n" for key, value in found.items())
        sigmas = "".join(f"{key} = {sigma}\n" for key, (_, sigma, *_) in VALUES.items())
        (folder / f"{flown:%Y-%m-%d}.toml").write_text(
            f"{head}\n[parameters]\n{parameters}{LEVER_ARM}\n[sigma]\n{sigmas}"
        )


def small(pdf: bytes) -> bytes:
    """Return a PDF whose pictures are JPEG, if it is large."""
    if len(pdf) < LARGE:
        return pdf
    writer = PdfWriter(clone_from=PdfReader(io.BytesIO(pdf)))
    for page in writer.pages:
        for image in page.images:
            assert image.image is not None
            image.replace(image.image.convert("RGB"), quality=QUALITY)
    held = io.BytesIO()
    writer.write(held)
    return held.getvalue()


def make(folder: Path) -> None:
    """Fly, process and judge in a folder, and copy the PDFs to docs/examples."""
    for name, command in FLIGHTS.items():
        if not (folder / name).is_dir():
            run(command, folder)
    for name, knocked in (("stays", False), ("knocked", True)):
        write_calibrations(folder / "history" / name, knocked=knocked)
    for command in TRAJECTORIES + GOOD:
        run(command, folder, (0, 1))  # 1: an effect that matters, or a verdict
    for command in BAD:
        run(command, folder, (0, 1))
    for name, page in PAGES.items():
        (path,) = folder.glob(page)
        (EXAMPLES / f"{name}.pdf").write_bytes(small(path.read_bytes()))


def main() -> None:
    """Make the examples in the folder that the command line names, or in a temporary one."""
    if len(sys.argv) > 1:
        folder = Path(sys.argv[1])
        folder.mkdir(parents=True, exist_ok=True)
        for made in ("nav", "report", "history"):
            shutil.rmtree(folder / made, ignore_errors=True)
        make(folder)
        return
    with tempfile.TemporaryDirectory() as name:
        make(Path(name))


if __name__ == "__main__":
    main()
