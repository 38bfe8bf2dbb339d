"""Which processors multiply bytes exactly: what a test of an int8 graph can ask of the one it runs on."""

from __future__ import annotations

import pytest
import torch


def skip_where_bytes_saturate(precision: str, form: str) -> None:
    """x86 without VNNI or AMX adds two products of bytes in 16 bits, which saturate (export/targets/cpu.toml)."""
    found = torch.cpu.get_capabilities()
    exact = found["architecture"] != "x86_64" or any(found[name] for name in ("avx512_vnni", "avx_vnni", "amx_int8"))
    if precision == "int8" and form == "fused" and not exact:
        pytest.skip("this processor's products of bytes saturate: int8 is less exact on it")
