"""Makes packages with drivers on the path of this process, as pip would install them."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from swath.drivers import driver, plugins
from tests.builders import ROOT

EXAMPLE = ROOT / "docs/examples/swath-example"
ENTRIES = {"example-scanner": "swath_example.scanner:DRIVER", "example-receiver": "swath_example.receiver:DRIVER"}


class Site:
    """A folder of installed packages.

    Attributes:
        folder: the folder; modules of the packages are written into it.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def install(self, name: str, entries: Mapping[str, str], code: str = "", version: str = "1.0") -> None:
        """Install a package of one module, named as the package, with entry points by protocol."""
        info = self.folder / f"{name.replace('-', '_')}-{version}.dist-info"
        info.mkdir(parents=True)
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
        lines = [f"{protocol} = {where}" for protocol, where in entries.items()]
        (info / "entry_points.txt").write_text("\n".join(["[swath.drivers]", *lines, ""]))
        if code:
            (self.folder / f"{name.replace('-', '_')}.py").write_text(code)
        forget()

    def install_example(self) -> None:
        """Install the example of docs/adding-a-device.md."""
        (self.folder / "swath_example").symlink_to(EXAMPLE / "swath_example")
        self.install("swath-example", ENTRIES)


def forget() -> None:
    """Let drivers of other packages be found anew."""
    plugins.entry_points.cache_clear()
    driver.all_drivers.cache_clear()
    driver._of_package.cache_clear()


@contextmanager
def site_at(folder: Path) -> Iterator[Site]:
    """Put a folder of packages on the path; afterwards its packages are as if they had never been there."""
    folder.mkdir()
    before = set(sys.modules)
    sys.path.insert(0, str(folder))
    try:
        yield Site(folder)
    finally:
        sys.path.remove(str(folder))
        for name in set(sys.modules) - before:
            if str(folder) in str(getattr(sys.modules[name], "__file__", "")):
                del sys.modules[name]
        forget()
