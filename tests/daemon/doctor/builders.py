"""Files of a system that tests of `swath doctor` write."""

from __future__ import annotations

from swath.daemon.doctor.finding import Tree

# Debian's and Ubuntu's chrony.conf without its time sources: conf.d comes before its own makestep
DEBIAN_CHRONY = """# Include configuration files found in /etc/chrony/conf.d.
confdir /etc/chrony/conf.d
pool 2.debian.pool.ntp.org iburst
sourcedir /run/chrony-dhcp
sourcedir /etc/chrony/sources.d
maxupdateskew 100.0
rtcsync
# Step the system clock instead of slewing it if the adjustment is larger than
# one second, but only in the first three clock updates.
makestep 1 3
"""


def write(tree: Tree, path: str, text: str) -> None:
    """Write a file of the tree, and the folders above it."""
    tree.at(path).parent.mkdir(parents=True, exist_ok=True)
    tree.at(path).write_text(text)
