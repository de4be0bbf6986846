"""The command `swath setup`: shows or sends the messages that the devices need before a survey."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from swath.daemon.errors import ExitCode

if TYPE_CHECKING:
    from rich.console import Console

    from swath.daemon.devices.setup import DeviceSetup, Step, WireSetup

MAX_BAUD = 20_000_000  # as in swath.drivers.transports.spec, whose import of NumPy would slow the help


def command(
    config: Annotated[Path, typer.Argument(metavar="CONFIG", help="Configuration, for example /etc/swath/swath.toml.")],
    apply: Annotated[bool, typer.Option("--apply", help="Send the messages and report each answer.")] = False,
    device: Annotated[
        list[str] | None, typer.Option(metavar="KIND/NAME", help="This device only, such as gnss/rover; repeatable.")
    ] = None,
    save: Annotated[bool, typer.Option("--save", help="Make the devices store the settings permanently.")] = False,
    from_baud: Annotated[
        int | None,
        typer.Option(
            help="Present baud rate of the device, if it differs from CONFIG; it is switched to CONFIG's.",
            min=1,
            max=MAX_BAUD,
        ),
    ] = None,
    timeout: Annotated[float, typer.Option(help="Seconds to wait for each answer.", min=0.1, max=60.0)] = 2.0,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object, for scripts.")] = False,
) -> None:
    """Show the messages that set up CONFIG's devices (rates, outputs, PPS); with --apply send them.

    Exit code 1 when a device rejects a message, does not answer, or cannot be reached.
    """
    from swath.daemon.config import load_config
    from swath.daemon.devices.setup import plan_setup

    wires = plan_setup(load_config(config), device or (), save=save, present_baud=from_baud)
    if apply:
        _apply(wires, timeout)
    devices = [found for wire in wires for found in wire.devices]
    ok = all(found.ok for found in devices)
    if as_json:
        document = {"config": str(config), "applied": apply, "ok": ok}
        print(json.dumps(document | {"devices": [found.plain() for found in devices]}, indent=2))
    else:
        _print_devices(devices, apply)
    if not ok:
        raise typer.Exit(int(ExitCode.PROBLEM))


def _apply(wires: list[WireSetup], timeout_s: float) -> None:
    from rich.console import Console

    from swath.daemon.devices.setup import apply_setup

    for wire in wires:
        with Console(stderr=True).status(f"setting up {wire.device.transport.text}"):
            apply_setup(wire, timeout_s)


def _print_devices(devices: list[DeviceSetup], applied: bool) -> None:
    from rich.console import Console

    console = Console(highlight=False, soft_wrap=True)
    for found in devices:
        console.print(f"{found.source}: {found.protocol} by {found.transport}", style="bold", markup=False)
        for step in found.steps:
            _print_step(console, step, applied)
        if found.problem:
            console.print(f"  {found.problem}", style="red", markup=False)
        elif not found.steps:
            console.print("  needs no set-up messages", style="dim")
    if not applied and any(found.steps for found in devices):
        console.print("nothing was sent; use --apply to send", style="dim")


def _print_step(console: Console, step: Step, applied: bool) -> None:
    title, *details = step.message.lines
    if not applied:
        console.print(f"  {title}", markup=False)
        for line in details:
            console.print(f"      {line}", markup=False)
        return
    style = {"accepted": "green", "not sent": "dim"}.get(step.outcome, "red")
    what = ": ".join((title, ", ".join(details))) if details else title
    answer = f" ({step.answer})" if step.answer else ""
    console.print(f"  {step.outcome:<9}  {what}{answer}", style=style, markup=False)
