"""Lists the tests that run on the emulated ARM64, and those that cannot, each with the reason.

Tests are left out if they need what qemu's user mode lacks: it passes system calls to the host's kernel and does not
know all of them. On real ARM64 all tests run by `make test` and `make test-slow`.
"""

from __future__ import annotations

TAKEN = (
    "tests/drivers",  # decoders; and transports, as far as qemu knows what they ask of the kernel
    "tests/georef",  # sensor model, trajectories, navigation, time scales, files
    "tests/daemon/log/test_log.py",  # the log: written, read, damaged, repaired, of strangers
    "tests/daemon/log/test_log_chunks.py",
    "tests/daemon/log/test_log_damage.py",
    "tests/daemon/log/test_log_stranger.py",
    "tests/daemon/cli/test_recover_cli.py",
    "tests/daemon/simulate/test_sim_log.py",
    "tests/daemon/exchange/test_import.py",  # captures to a log, and back
    "tests/daemon/exchange/test_export.py",
    "tests/daemon/processing/points/test_processing_feed.py",  # a log to points
    "tests/daemon/test_priority.py",  # numbers of system calls
)
_UDP = "qemu's user mode does not know SO_MEMINFO, by which datagrams are counted that the kernel dropped"
_PPS = "qemu's user mode answers an ioctl that it does not know by ENOSYS"
_HOLDER = "under qemu a process has the emulator's name"
_EXPORT = "tests/daemon/exchange/test_export.py"
_CAN = "tests/drivers/transports/can/test_transport_can.py::test_"
LEFT_OUT = {  # by the beginning of the test's name
    "tests/drivers/transports/test_transport_udp.py": _UDP,
    f"{_CAN}frames_come_in_order_with_the_kernels_stamps": _UDP,
    f"{_CAN}classic_and_fd_frames_mixed": _UDP,
    f"{_CAN}error_frames_and_bus_off_are_units_and_counted": _UDP,
    f"{_CAN}garbage_on_the_group_is_counted_and_skipped": _UDP,
    f"{_CAN}received_and_lost_are_exactly_what_was_sent": _UDP,
    f"{_CAN}close_from_another_thread_ends_a_blocked_receive[can:udp_multicast": _UDP,
    f"{_CAN}the_readers_slots_for_frames_keep_classic_and_fd_apart": _UDP,
    "tests/drivers/transports/pps/test_transport_pps.py::test_error_on_opening_gives_the_reason[source3": _PPS,
    "tests/drivers/transports/test_transport_serial.py::test_a_port_held_by_another_process_is_refused": _HOLDER,
    f"{_EXPORT}::test_units_on_the_wire_are_exported_and_restored": f"records UDP: {_UDP}",
}
