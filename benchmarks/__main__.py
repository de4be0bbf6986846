"""All benchmarks, one after the other: ``python -m benchmarks``; each has options of its own, see its ``--help``."""

from benchmarks import acquire, clock, decode, raycast

decode.main()
raycast.main()
clock.main()
acquire.main()
