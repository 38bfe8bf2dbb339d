"""What differs between the two Cyclone DDS bindings for Python that work: 11.0 (wheels) and 0.10 (built on a board).

Octets must be announced as the robot's 0.10.2 announces them. cyclonedds-python 11 has `byte` for that and announces
its `uint8` as the XTypes kind TK_UINT8, which Cyclone DDS 0.10.2 does not know: its discovery thread crashes. In
cyclonedds-python 0.10 `byte` does not exist and `uint8` is announced as TK_BYTE. The bytes on the wire are equal.
"""

import ctypes
from typing import TYPE_CHECKING, Any, Final

import cyclonedds.idl.types as t
from cyclonedds._clayer import ddspy_take
from cyclonedds.core import InstanceState, SampleState, ViewState
from cyclonedds.internal import DDS

_IS_0_10: Final = not hasattr(t, "byte")
_ANY: Final = ViewState.Any | InstanceState.Any | SampleState.Any

if TYPE_CHECKING:
    Octet = int
else:
    Octet = t.uint8 if _IS_0_10 else t.byte


def take_undecoded(reader: Any) -> Any:
    """Take one waiting sample of a DataReader: a list of at most one (bytes, info), or a DDS return code (int)."""
    return ddspy_take(reader._ref, 1) if _IS_0_10 else ddspy_take(reader._ref, _ANY, 1)


def has_reader(writer: Any) -> bool:
    """Return whether discovery has matched a reader with this DataWriter (the binding 0.10 has no method for it)."""
    return bool(DDS._dll_handle.dds_get_matched_subscriptions(writer._ref, None, ctypes.c_size_t(0)) > 0)


def has_writer(reader: Any) -> bool:
    """Return whether discovery has matched a writer with this DataReader."""
    return bool(DDS._dll_handle.dds_get_matched_publications(reader._ref, None, ctypes.c_size_t(0)) > 0)
