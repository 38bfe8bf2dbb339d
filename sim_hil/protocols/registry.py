"""Registry of protocols: which robot uses which protocol, and how its front end is opened.

A protocol is a package sim_hil/protocols/NAME whose module `front_end` has `open_front_end(simulation, options) ->
FrontEnd`. It is imported on demand, so that using one protocol does not require the library of another.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Final

from sim_hil.protocols.front_end import FrontEnd, FrontEndError, FrontEndOptions

if TYPE_CHECKING:
    from sim_hil.simulation.physics import Simulation  # loads physics: a command line is checked without it

_FOLDER: Final = Path(__file__).parent
Opener = Callable[["Simulation", FrontEndOptions], FrontEnd]

_SPOKEN_BY: Final[Mapping[str, tuple[str, ...]]] = MappingProxyType(
    {"unitree": ("go2",), "mavlink": ("carter",), "can": ("carter",), "ros2": ("carter",)}
)

FLAGS: Final[Mapping[str, tuple[str, ...]]] = MappingProxyType(
    {"--domain": ("unitree", "ros2"), "--interface": ("unitree", "ros2"), "--link": ("mavlink", "can")}
)
"""Command-line options that only some protocols have."""


def protocols() -> tuple[str, ...]:
    """Return the names of the installed protocols."""
    return tuple(name for name in _SPOKEN_BY if (_FOLDER / name / "front_end.py").is_file())


def robots() -> tuple[str, ...]:
    """Return the robots with an installed protocol."""
    return tuple(dict.fromkeys(robot for name in protocols() for robot in _SPOKEN_BY[name]))


def check_combination(robot: str, protocol: str) -> None:
    """Check that `robot` uses `protocol`. Raises FrontEndError."""
    if robot not in _SPOKEN_BY[protocol]:
        spoken = [name for name in protocols() if robot in _SPOKEN_BY[name]]
        raise FrontEndError(
            f"--robot {robot} --protocol {protocol}: expected a protocol of this robot, {' or '.join(spoken)}"
        )


def check_flags(protocol: str, given: Sequence[str]) -> None:
    """Check that `protocol` has all the `given` FLAGS. Raises FrontEndError."""
    for flag in given:
        if protocol not in FLAGS[flag]:
            own = " and ".join(name for name, speakers in FLAGS.items() if protocol in speakers)
            others = " or ".join(FLAGS[flag])
            raise FrontEndError(f"{flag}: expected only with --protocol {others}; for {protocol} use {own} instead")


def open_front_end(protocol: str, simulation: Simulation, options: FrontEndOptions) -> FrontEnd:
    """Open a protocol's front end. Raises FrontEndError, or the protocol library's error for a bad address."""
    opener: Opener = importlib.import_module(f"sim_hil.protocols.{protocol}.front_end").open_front_end
    return opener(simulation, options)
