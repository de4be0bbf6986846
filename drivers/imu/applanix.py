"""The INS of a Trimble or Applanix system, inside its own stream (``transport = "gnss:NAME"``)."""

from __future__ import annotations

from swath.drivers.driver import Driver
from swath.drivers.gnss.applanix.parser import GsofParser, PosParser
from swath.georef.records import InsSolution

DRIVERS = (
    Driver(
        protocol="gsof",
        kind="imu",
        transports=("gnss",),
        yields=(InsSolution,),
        summary="INS of a Trimble or Applanix receiver, inside its GSOF stream",
        make_parser=lambda settings: GsofParser(settings, wanted=(InsSolution,)),
    ),
    Driver(
        protocol="applanix-pos",
        kind="imu",
        transports=("gnss",),
        yields=(InsSolution,),
        summary="INS of an Applanix POS, inside its stream of groups",
        make_parser=lambda settings: PosParser(settings, wanted=(InsSolution,)),
    ),
)
