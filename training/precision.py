"""bfloat16 where the device computes in it; elsewhere it would be slower than float32."""

from __future__ import annotations

import torch


def autocast(device: torch.device) -> torch.autocast:
    """Return the context in which networks are run on `device`."""
    known = torch.cpu.get_capabilities()
    native = device.type != "cpu" or known.get("avx512_bf16") or known.get("amx_bf16")
    return torch.autocast(device.type, torch.bfloat16, enabled=bool(native))
