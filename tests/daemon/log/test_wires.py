"""Tests when several senders count as several devices: runs in turn do, a change of address does not."""

from __future__ import annotations

import pytest

from swath.daemon.log.wires import Senders, mixed_text


@pytest.mark.parametrize(
    ("runs", "mixed"),
    [
        ("AAAA", False),
        ("AAABBB", False),  # the head got another address
        ("AABBAA", False),  # and its own one again
        ("ABABAB", True),
        ("AABBAABB", True),
    ],
)
def test_senders_in_turn_are_several_devices(runs: str, mixed: bool) -> None:
    senders = Senders()
    for at, address in enumerate(runs):
        senders.add(address, 10 * at, 10 * at + 9, 3)
    assert senders.mixed is mixed
    assert senders.counts == {address: 3 * runs.count(address) for address in set(runs)}


def test_runs_that_overlap_in_time_are_of_several_devices() -> None:
    senders = Senders()
    senders.add("A", 0, 90, 10)
    senders.add("B", 5, 95, 10)
    assert senders.mixed


def test_a_line_names_the_most_frequent_senders_and_the_remedy() -> None:
    text = mixed_text({f"192.168.1.{last}": last for last in range(1, 8)}, recorded=True)
    assert text.startswith("7 devices send to its port")
    assert "192.168.1.7, 192.168.1.6, 192.168.1.5, 192.168.1.4 and 3 more; give each a section" in text
    assert "swath export" in text
