"""Which robot speaks which protocol, and how a protocol's robot half is opened.

A protocol is a package sim_hil/protocols/NAME whose module `front_end` has `open_front_end(simulation, options) ->
FrontEnd`. It is imported by name when it is asked for: one protocol's library is not needed to speak another.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Final

from sim_hil.protocols.front_end import FrontEnd, FrontEndError, FrontEndOptions
from sim_hil.simulation.physics import Simulation

_FOLDER: Final = Path(__file__).parent
Opener = Callable[[Simulation, FrontEndOptions], FrontEnd]

_SPOKEN_BY: Final[Mapping[str, tuple[str, ...]]] = MappingProxyType(
    {"unitree": ("go2",), "mavlink": ("carter",), "can": ("carter",)}
)

FLAGS: Final[Mapping[str, tuple[str, ...]]] = MappingProxyType(
    {"--domain": ("unitree",), "--interface": ("unitree",), "--link": ("mavlink", "can")}
)
"""Options of the command line that only some protocols have."""


def protocols() -> tuple[str, ...]:
    """The protocols that are there."""
    return tuple(name for name in _SPOKEN_BY if (_FOLDER / name / "front_end.py").is_file())


def robots() -> tuple[str, ...]:
    """The robots that speak one of them."""
    return tuple(dict.fromkeys(robot for name in protocols() for robot in _SPOKEN_BY[name]))


def check_combination(robot: str, protocol: str) -> None:
    """Raises FrontEndError unless `robot` speaks `protocol`."""
    if robot not in _SPOKEN_BY[protocol]:
        spoken = [name for name in protocols() if robot in _SPOKEN_BY[name]]
        raise FrontEndError(
            f"--robot {robot} --protocol {protocol}: expected a protocol that this robot speaks, {' or '.join(spoken)}"
        )


def check_flags(protocol: str, given: Sequence[str]) -> None:
    """Raises FrontEndError for the first of the `given` FLAGS that `protocol` does not have."""
    for flag in given:
        if protocol not in FLAGS[flag]:
            own = " and ".join(name for name, speakers in FLAGS.items() if protocol in speakers)
            others = " or ".join(FLAGS[flag])
            raise FrontEndError(f"{flag}: is for --protocol {others}, {protocol} is reached by {own}; leave it out")


def open_front_end(protocol: str, simulation: Simulation, options: FrontEndOptions) -> FrontEnd:
    """Raises FrontEndError, or what the protocol's own library raises for an address that cannot be opened."""
    opener: Opener = importlib.import_module(f"sim_hil.protocols.{protocol}.front_end").open_front_end
    return opener(simulation, options)
