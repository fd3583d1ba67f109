"""Set pins low permanently with lgpio alone: at the end of a drive, and after a driver was killed. Shell.

    python -m sightline.robot_side.hardware.gpio_low 10 9 8 7

It needs neither gpiozero nor a configuration. The internal pull-down (about 50 kilohms) remains after the program, when
the kernel turns a pin without an owner into an input.
"""

import importlib
import os
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Any, Final

_CHIPS: Final = (0, 4)
"""Chip of the header: 4 on a Raspberry Pi 5 with an early kernel, otherwise 0."""
_HEADER_LABEL: Final = "pinctrl-"


def import_lgpio() -> Any:
    """Import lgpio in a temporary folder, because it creates a pipe in the current folder and may fail there."""
    if "lgpio" in sys.modules or "LG_WD" in os.environ:
        return importlib.import_module("lgpio")
    # Only `os`, because `tempfile` and `pathlib` would cost the guardian 1.8 MB.
    here = os.getcwd()  # noqa: PTH109  lgpio changes the current folder, so relative paths must be restored
    memory = "/dev/shm" if os.access("/dev/shm", os.W_OK) else os.environ.get("TMPDIR", "/tmp")  # the disk may be full
    folder = f"{memory}/sightline-{os.urandom(8).hex()}"
    os.mkdir(folder, 0o700)  # noqa: PTH102
    os.environ["LG_WD"] = folder
    try:
        return importlib.import_module("lgpio")
    finally:
        del os.environ["LG_WD"]
        os.chdir(here)
        for name in os.listdir(folder):  # noqa: PTH208
            os.unlink(f"{folder}/{name}")  # noqa: PTH108
        os.rmdir(folder)  # noqa: PTH106


def prepare() -> None:
    """Import lgpio before `zero` needs it, because the card may fail together with the driver."""
    with suppress(Exception):  # without lgpio the drive does not open either, and reports the reason
        import_lgpio()


def zero(config: Mapping[str, Any]) -> None:
    """Set the pins of a `gpio` drive low, the enable pins first. `config`: its `Config` as plain values."""
    sides = ("left_forward_pin", "left_backward_pin", "right_forward_pin", "right_backward_pin")
    leave_low([*config["enable_pins"], *(config[side] for side in sides)])


def leave_low(numbers: Sequence[int], chip: int | None = None) -> None:
    """Make the pins outputs, low and with a pull-down. It tries every pin, then raises any error of lgpio."""
    lgpio = import_lgpio()
    handle = lgpio.gpiochip_open(chip) if chip is not None else _header(lgpio)
    troubles: list[Exception] = []
    try:
        for number in numbers:
            try:
                lgpio.gpio_claim_output(handle, number, 0, lgpio.SET_PULL_DOWN)
            except Exception as error:
                troubles.append(error)
    finally:
        lgpio.gpiochip_close(handle)
    if troubles:
        raise troubles[0]


def _header(lgpio: Any) -> Any:
    """Open the chip of the header pins."""
    for chip in _CHIPS:
        try:
            handle = lgpio.gpiochip_open(chip)
        except Exception:  # no such chip
            continue
        if str(lgpio.gpio_get_chip_info(handle)[3]).startswith(_HEADER_LABEL):
            return handle
        lgpio.gpiochip_close(handle)
    raise RuntimeError("no GPIO here: this needs a Raspberry Pi and a user in the group gpio")


def main(arguments: Sequence[str]) -> int:
    """Exit 0, or 3 with one line."""
    if not arguments or not all(text.isascii() and text.isdigit() and int(text) <= 27 for text in arguments):
        print("error: name the BCM numbers of the pins, e.g. 10 9 8 7", file=sys.stderr)
        return 2
    try:
        leave_low([int(text) for text in arguments])
    except Exception as error:
        print(f"error: pins {', '.join(arguments)}: {' '.join(str(error).split())}", file=sys.stderr)
        return 3
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
