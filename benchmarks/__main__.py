"""All benchmarks, one after the other: ``python -m benchmarks``; each has options of its own, see its ``--help``."""

from benchmarks import acquire, clock, decode, georef, georef_log, raycast

decode.main()
georef.main()
georef_log.main()
raycast.main()
clock.main()
acquire.main()
