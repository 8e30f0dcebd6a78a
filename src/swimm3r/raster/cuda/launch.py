"""Warp kernels on torch's tensors and current stream, without a copy and without waiting for the device."""

from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import torch
import warp as wp
from torch import Tensor

# No banner, no "module loaded" lines: they would land in the middle of the command line's progress. The first name is
# Warp's before 1.19, the second since.
setattr(wp.config, "quiet", True)  # noqa: B010
wp.config.log_level = 30
wp.init()


def torch_stream(device: torch.device) -> AbstractContextManager[Any]:
    """The stream that torch uses now, as Warp's of this device; on Warp's CPU device, which has none, nothing."""
    if device.type != "cuda":
        return nullcontext()
    return wp.ScopedStream(wp.stream_from_torch(torch.cuda.current_stream(device)), sync_enter=False)


def launch(kernel: Any, dim: Sequence[int], arguments: Sequence[Tensor | float], block_dim: int = 256) -> None:
    """One thread per index of `dim`, on the device of the first argument, which is a tensor."""
    first = arguments[0]
    assert isinstance(first, Tensor)
    with torch_stream(first.device):
        inputs = [
            wp.from_torch(value.detach(), requires_grad=False) if isinstance(value, Tensor) else value
            for value in arguments
        ]
        wp.launch(kernel, dim=tuple(dim), inputs=inputs, device=wp.device_from_torch(first.device), block_dim=block_dim)
