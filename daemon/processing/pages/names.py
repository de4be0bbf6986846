"""Names the files that pages consist of, for the commands that write them and for whoever removes those of old runs."""

from __future__ import annotations

PRINTED = ".pdf"  # the PDF beside a page has its stem
# `swath trajectory` names its page after the trajectory's own file.
QUICK_LOOK, STRIPS, VALIDATION, REPORT = "index.html", "strips.html", "validation.html", "report.html"
VIEW_RECORD = "view.json"  # of `swath view`: its files, and the points that they show
QUICK_LOOK_PICTURES = ("height.png", "differences.png", "profile.png", "density.png", "intensity.png", "sigma.png")
QUICK_LOOK_MAPS = ("height.tif", "differences.tif", "density.tif", "intensity.tif", "sigma.tif")
QUICK_LOOK_FEATURES = "view.gpkg"
STRIPS_PICTURES = ("differences.png", "differences_before.png")
HISTORY_PICTURE = "history.png"
HISTORY, HISTORY_TABLE = "history.html", "history.csv"
# Every name that a command may write for people into its folder, the record for scripts not included.
OF_COMMAND = {
    "view": (QUICK_LOOK, "index.pdf", *QUICK_LOOK_PICTURES, *QUICK_LOOK_MAPS, QUICK_LOOK_FEATURES),
    "strips": (STRIPS, "strips.pdf", *STRIPS_PICTURES),
    "validate": (VALIDATION, "validation.pdf", HISTORY_PICTURE),
    "calibrate": (REPORT, "report.pdf"),
    "history": (HISTORY, "history.pdf"),
}
