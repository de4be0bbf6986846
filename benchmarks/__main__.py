"""Run every benchmark that takes minutes, one after the other: ``python -m benchmarks``.

Each module has options of its own, which its ``--help`` lists. Benchmarks that take longer have only their own
command.
"""

from benchmarks import (
    acquire,
    adjustment,
    clock,
    decode,
    error_model,
    georef,
    georef_log,
    listen,
    navigation,
    navigation_honesty,
    navigation_seeds,
    planes,
    raycast,
)
from benchmarks.inflight import extra

decode.main()
georef.main()
georef_log.main()
raycast.main()
navigation.main()
navigation_honesty.main()
navigation_seeds.main()
adjustment.main()
planes.main()
error_model.main()
clock.main()
acquire.main()
listen.main()
extra.main()
