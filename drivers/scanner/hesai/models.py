"""The Hesai heads: an entry for each model.

Sources: PandarXT-32 and PandarXT-16 User Manual (3.1.2, Appendix I and II), XT32M2X User Manual, PandarQT User Manual
(3.1.2, Appendix I); the maker's HesaiLidar_SDK_2.0 (correction/firetime_correction, correction/angle_correction,
libhesai/UdpProtocol, libhesai/UdpParser) and HesaiLidar_General_SDK (pandarXT.h, pandarQT.h) for layouts, tables of
firing times and design angles.
"""

from __future__ import annotations

import numpy as np

from swath.drivers.scanner.beams import beam_table, numbers
from swath.drivers.scanner.hesai.heads import (
    CONFIDENCE,
    FIRST_ROUND,
    LAST_ROUND,
    MODE_FIRST_LAST_STRONGEST,
    MODE_FIRST_SECOND,
    MODE_SECOND,
    MODE_STRONGEST_SECOND,
    SAFETY,
    SEQUENCE,
    SIGNATURE,
    USUAL_MODES,
    Fields,
    HesaiHead,
)
from swath.georef.arrays import Int64Array, StructArray

XT_TAIL: Fields = (
    ("tail_reserved", "V10"),
    ("mode", "u1"),
    ("motor_rpm", "<u2"),
    ("utc", "V6"),
    ("microsecond", "<u4"),
    ("factory", "u1"),
)

# Point cloud packet 1080 bytes (3.1.2). Block N fires at t0 + 5.632 µs − 50 µs (8 − N), in dual return blocks 2N − 1
# and 2N at t0 + 5.632 µs − 50 µs (4 − N); channel n 0.368 µs + 1.512 µs (n − 1) after that (Appendix II; the maker's
# firetime correction file counts 6 µs + 1.512 µs (n − 1) from t0). Design angles 15° to −16°, no azimuth offsets.
XT32 = HesaiHead(
    name="PandarXT-32",
    protocol_major=6,
    blocks=8,
    channels=32,
    tail=XT_TAIL,
    flags=SEQUENCE,
    round_ns=50_000,
    stamped_round=LAST_ROUND,
    start_ns=0,
    offset_ns=6_000 + 1_512 * np.arange(32, dtype=np.int64)[np.newaxis],
    beams=beam_table(np.arange(15.0, -17.0, -1.0)),
)

# Point cloud packet 568 bytes; as the PandarXT-32, with every second laser: channel n fires 3.024 µs (n − 1) after the
# first (the maker's firetime correction file). Design angles 15° to −15°, no azimuth offsets.
XT16 = HesaiHead(
    name="PandarXT-16",
    protocol_major=6,
    blocks=8,
    channels=16,
    tail=XT_TAIL,
    flags=SEQUENCE,
    round_ns=50_000,
    stamped_round=LAST_ROUND,
    start_ns=0,
    offset_ns=6_000 + 3_024 * np.arange(16, dtype=np.int64)[np.newaxis],
    beams=beam_table(np.arange(15.0, -17.0, -2.0)),
)

# Point cloud packet 820 bytes: 6 blocks, which are 6, 3 or 2 rounds. Two lasers fire at once, channel n with n + 16,
# 2.888 µs after the pair before (the maker's firetime correction file). Distances in 5 mm, or in what else of 4 and 5
# the header states. Design angles 19.5° to −20.8° in steps of 1.3°.
XT32M2X = HesaiHead(
    name="XT32M2X",
    protocol_major=6,
    blocks=6,
    channels=32,
    tail=XT_TAIL,
    flags=SEQUENCE,
    round_ns=50_000,
    stamped_round=LAST_ROUND,
    start_ns=0,
    offset_ns=6_000 + 2_888 * (np.arange(32, dtype=np.int64) % 16)[np.newaxis],
    beams=beam_table(19.5 - 1.3 * np.arange(32)),
    units_mm=(4, 5),
    modes=(*USUAL_MODES, MODE_SECOND, MODE_FIRST_SECOND, MODE_FIRST_LAST_STRONGEST),
)

# Point cloud packet 1072 bytes, 1068 without UDP sequence (3.1.2). Block N fires at t0 + 25.71 µs + 166.67 µs (N − 1),
# in dual return two blocks at once; channel n as listed by the firetime correction file, 10 µs after that
# (HesaiLidar_General_ROS). Angles as listed by pandarQT.h.
_QT_FIRES_US = """
2.31 4.37 6.43 8.49 10.54 12.6 14.66 16.71 19.16 21.22 23.28 25.34 27.39 29.45 31.5 33.56
36.61 38.67 40.73 42.78 44.84 46.9 48.95 51.01 53.45 55.52 57.58 59.63 61.69 63.74 65.8 67.86
70.9 72.97 75.02 77.08 79.14 81.19 83.25 85.3 87.75 89.82 91.87 93.93 95.98 98.04 100.1 102.15
105.2 107.26 109.32 111.38 113.43 115.49 117.54 119.6 122.05 124.11 126.17 128.22 130.28 132.34 134.39 136.45
"""
_QT_ELEVATION_DEG = """
-52.121 -49.785 -47.577 -45.477 -43.465 -41.528 -39.653 -37.831 -36.055 -34.32 -32.619 -30.95 -29.308 -27.69 -26.094
-24.517 -22.964 -21.42 -19.889 -18.372 -16.865 -15.368 -13.88 -12.399 -10.925 -9.457 -7.994 -6.535 -5.079 -3.626
-2.175 -0.725 0.725 2.175 3.626 5.079 6.534 7.993 9.456 10.923 12.397 13.877 15.365 16.861 18.368 19.885 21.415 22.959
24.524 26.101 27.697 29.315 30.957 32.627 34.328 36.064 37.84 39.662 41.537 43.475 45.487 47.587 49.795 52.133
"""
_QT_AZIMUTH_DEG = """
8.736 8.314 7.964 7.669 7.417 7.198 7.007 6.838 6.688 6.554 6.434 6.326 6.228 6.14 6.059 5.987 -5.27 -5.216 -5.167
-5.123 -5.083 -5.047 -5.016 -4.988 -4.963 -4.942 -4.924 -4.91 -4.898 -4.889 -4.884 -4.881 5.493 5.496 5.502 5.512
5.525 5.541 5.561 5.584 5.611 5.642 5.676 5.716 5.759 5.808 5.862 5.921 -5.33 -5.396 -5.469 -5.55 -5.64 -5.74 -5.85
-5.974 -6.113 -6.269 -6.447 -6.651 -6.887 -7.163 -7.493 -7.892
"""

QT64 = HesaiHead(
    name="PandarQT",
    protocol_major=3,
    blocks=4,
    channels=64,
    tail=(
        ("tail_reserved", "V10"),
        ("motor_rpm", "<u2"),
        ("microsecond", "<u4"),
        ("mode", "u1"),
        ("factory", "u1"),
        ("utc", "V6"),
    ),
    flags=SEQUENCE,
    optional=SEQUENCE,
    round_ns=500_000 / 3,
    stamped_round=FIRST_ROUND,
    start_ns=25_710 + 10_000,
    offset_ns=np.rint(1000 * np.array(numbers(_QT_FIRES_US))).astype(np.int64)[np.newaxis],
    beams=beam_table(numbers(_QT_ELEVATION_DEG), azimuth_deg=numbers(_QT_AZIMUTH_DEG)),
)

# Point cloud packet 1127 bytes, of protocol 3.2: two blocks, a CRC behind them, functional safety, tail with a CRC, a
# signature; the header's flags tell which of confidence, functional safety, UDP sequence and signature are there. Block
# N fires at t0 + 9 µs + 111.11 µs (N − 1), in dual return both blocks at once. Of the 128 lasers 96 fire in a round, in
# two alternating orders (loops): three lasers in 3.168 µs. The order of the packet's first round is that of the second
# loop where the tail's mode flag is even (udp3_2_parser.cc). Angles as in the maker's angle correction file,
# which nebula carries too.
_QT128_LOOP_1 = """
99 65 35 102 72 38 107 73 43 110 80 46 115 81 51 118 88 54 123 89 59 126 96 62 97 67 33 104 70 40 105 75 41 112 78 48
113 83 49 120 86 56 121 91 57 128 94 64 98 68 34 103 69 39 106 76 42 111 77 47 114 84 50 119 85 55 122 92 58 127 93 63
100 66 36 101 71 37 108 74 44 109 79 45 116 82 52 117 87 53 124 90 60 125 95 61
"""
_QT128_LOOP_2 = """
65 99 1 72 102 8 73 107 9 80 110 16 81 115 17 88 118 24 89 123 25 96 126 32 67 97 3 70 104 6 75 105 11 78 112 14 83
113 19 86 120 22 91 121 27 94 128 30 68 98 4 69 103 5 76 106 12 77 111 13 84 114 20 85 119 21 92 122 28 93 127 29 66
100 2 71 101 7 74 108 10 79 109 15 82 116 18 87 117 23 90 124 26 95 125 31
"""
_QT128_ELEVATION_DEG = """
-52.6268 -51.0281 -49.515 -48.0739 -46.6947 -45.3688 -44.0897 -42.8519 -41.6507 -40.4823 -39.3433 -38.2309 -37.1426
-36.0764 -35.0302 -34.0024 -32.9916 -31.9963 -31.0154 -30.0479 -29.0926 -28.1488 -27.2157 -26.2924 -25.3784 -24.4729
-23.5754 -22.6854 -21.8024 -20.9259 -20.0555 -19.1908 -18.3314 -17.4769 -16.6271 -15.7815 -14.9399 -14.1021 -13.2677
-12.4365 -11.6082 -10.7826 -9.9595 -9.1387 -8.3199 -7.503 -6.6878 -5.8739 -5.0614 -4.2499 -3.4394 -2.6296 -1.8204
-1.0115 -0.2029 0.6057 1.4144 2.2235 3.033 3.8431 4.6541 5.466 6.2792 7.0937 7.9098 8.7276 9.5474 10.3693 11.1936
12.0205 12.8502 13.6829 14.519 15.3587 16.2022 17.0499 17.902 18.7589 19.6209 20.4884 21.3618 22.2415 23.1279 24.0216
24.9229 25.8326 26.7512 27.6793 28.6176 29.567 30.5283 31.5024 32.4903 33.4931 34.5122 35.549 19.1908 20.0555 20.9259
21.8024 22.6854 23.5754 24.4729 25.3784 26.2924 27.2157 28.1488 29.0926 30.0479 31.0154 31.9963 32.9916 34.0024
35.0302 36.0764 37.1426 38.2309 39.3433 40.4823 41.6507 42.8519 44.0897 45.3688 46.6947 48.0739 49.515 51.0281 52.6268
"""
_QT128_AZIMUTH_DEG = """
10.1083 9.7195 9.3843 9.0914 8.8329 8.6026 8.3959 8.2092 8.0396 7.8848 7.7429 7.6123 7.4918 7.3802 7.2766 7.1802
7.0903 7.0064 6.9278 6.8543 6.7853 6.7205 6.6597 6.6024 6.5486 6.4979 6.4501 6.4052 6.3628 6.323 6.2855 6.2502 -6.217
-6.1858 -6.1566 -6.1292 -6.1036 -6.0797 -6.0574 -6.0367 -6.0175 -5.9998 -5.9836 -5.9688 -5.9553 -5.9432 -5.9267
-5.9229 -5.9146 -5.9076 -5.9019 -5.8974 -5.894 -5.8919 -5.891 -5.8913 -5.8928 -5.8955 -5.8995 -5.9046 -5.911 -5.9186
-5.9275 -5.9376 5.9491 5.9618 5.976 5.9915 6.0085 6.0269 6.0468 6.0683 6.0914 6.1161 6.1426 6.1709 6.2011 6.2333
6.2675 6.3039 6.3425 6.3836 6.4272 6.4736 6.5227 6.575 6.6305 6.6895 6.7523 6.8191 6.8903 6.9663 7.0475 7.1343 7.2273
7.3272 -6.2502 -6.2855 -6.323 -6.3628 -6.4052 -6.4501 -6.4979 -6.5486 -6.6024 -6.6597 -6.7205 -6.7853 -6.8543 -6.9278
-7.0064 -7.0903 -7.1802 -7.2766 -7.3802 -7.4918 -7.6123 -7.7429 -7.8848 -8.0396 -8.2092 -8.3959 -8.6026 -8.8329
-9.0914 -9.3843 -9.7195 -10.1083
"""


def _qt128_loop(order: str) -> Int64Array:
    """Return (128,) firing times of lasers listed in their order; 0 for those that do not fire."""
    at = np.arange(96)
    times = np.zeros(128, dtype=np.int64)
    times[np.array(numbers(order), dtype=np.intp) - 1] = 600 + 3_168 * (at // 3) + 856 * (at % 3)
    return times


def _qt128_states(packets: StructArray, rounds: int) -> Int64Array:
    """Return (n, rounds) loops: 0 the first, 1 the second."""
    flag = packets["mode_flag"].astype(np.int64)[:, np.newaxis]
    loops: Int64Array = (flag + np.arange(rounds) + 1) % 2
    return loops


QT128 = HesaiHead(
    name="QT128C2X",
    protocol_major=3,
    protocol_minor=2,
    blocks=2,
    channels=128,
    tail=(
        ("tail_reserved", "V5"),
        ("mode_flag", "u1"),
        ("status", "V3"),
        ("azimuth_flag", "<u2"),
        ("operation", "u1"),
        ("mode", "u1"),
        ("motor_rpm", "<u2"),
        ("utc", "V6"),
        ("microsecond", "<u4"),
        ("factory", "u1"),
    ),
    flags=SEQUENCE | SAFETY | SIGNATURE | CONFIDENCE,
    optional=SEQUENCE | SAFETY | SIGNATURE | CONFIDENCE,
    round_ns=111_110,
    stamped_round=FIRST_ROUND,
    start_ns=9_000,
    offset_ns=np.stack([_qt128_loop(_QT128_LOOP_1), _qt128_loop(_QT128_LOOP_2)]),
    beams=beam_table(numbers(_QT128_ELEVATION_DEG), azimuth_deg=numbers(_QT128_AZIMUTH_DEG)),
    channel_bytes=3,
    has_crc=True,
    checks_crc=True,
    modes=(*USUAL_MODES, MODE_SECOND, MODE_FIRST_SECOND, MODE_STRONGEST_SECOND),
    states=_qt128_states,
)
