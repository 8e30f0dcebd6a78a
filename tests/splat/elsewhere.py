"""A pretended accelerator: tensors that say they are elsewhere, while an ordinary tensor holds their values.

Code that mixes them with ordinary tensors, reads their memory, or makes new ones in the wrong place fails as it would
on a GPU; what it computes can be compared with the processor's. Torch's "meta" device is what they claim to be on: the
one besides the processor that autograd takes without a driver.
"""

import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten, tree_map

DEVICE = torch.device("meta")
_MAY_MIX = {"aten::copy_", "aten::_to_copy"}  # what goes from one place to the other
_INDICES_FROM_ANYWHERE = {"aten::index", "aten::index_put", "aten::index_put_"}
_NO_SCALARS = {"aten::_fused_adam_"}  # elsewhere a number of the processor's may be mixed with the device's tensors
_WAITS = {"aten::_local_scalar_dense", "aten::nonzero", "aten::_unique2", "aten::repeat_interleave", "aten::bincount"}
waits: list[str] = []
"""Places in the package where the CPU has waited for the device, in order; a test that counts them empties it first."""


class Elsewhere(Tensor):
    """A tensor on the pretended device."""

    held: Tensor

    @staticmethod
    def __new__(cls, held: Tensor) -> "Elsewhere":
        made = Tensor._make_wrapper_subclass(
            cls,
            held.shape,
            strides=held.stride(),
            storage_offset=held.storage_offset(),
            dtype=held.dtype,
            device=DEVICE,
        )
        made.held = held
        return made

    def __repr__(self, **_: Any) -> str:  # pyright: ignore[reportIncompatibleMethodOverride]
        return f"Elsewhere({self.held})"

    def tolist(self) -> Any:
        """As any tensor's; torch has none for other kinds."""
        return self.held.tolist()

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _run(func, args, kwargs or {})


class Pretended(TorchDispatchMode):
    """While it is on, DEVICE is a device."""

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _run(func, args, kwargs or {})


def held(t: Tensor) -> Tensor:
    """The values of a tensor that may be elsewhere."""
    return t.held if isinstance(t, Elsewhere) else t


def _picks_by_mask(name: str, args: Any) -> bool:
    picking = args[1] if name == "aten::index" else []
    return any(t is not None and t.dtype == torch.bool for t in picking)


def _who() -> str:
    """The innermost of the package's files and functions on the stack."""
    ours = [frame for frame in traceback.extract_stack() if "/src/swimm3r/" in frame.filename]
    return f"{Path(ours[-1].filename).name}:{ours[-1].name}" if ours else "outside"


def _run(func: Callable[..., Any], args: Any, kwargs: dict[str, Any]) -> Any:
    name = func._schema.name  # pyright: ignore[reportFunctionMemberAccess]
    given = [t for t in tree_flatten((args, kwargs))[0] if isinstance(t, Tensor)]
    away = any(isinstance(t, Elsewhere) for t in given)
    checked = [args[0], *args[2:3]] if name in _INDICES_FROM_ANYWHERE else given  # what is indexed, and what is put
    if away and name not in _MAY_MIX:
        here = [t for t in checked if isinstance(t, Tensor) and not isinstance(t, Elsewhere)]
        strangers = [t for t in here if t.dim() or name in _NO_SCALARS]
        assert not strangers, f"{name} of tensors on the device and on the processor"
    empty = [t for t in given if t.device.type == DEVICE.type and not isinstance(t, Elsewhere)]
    assert not empty, f"{name} of a tensor made with torch.tensor(..., device=): only .to(device) is seen here"
    asked = kwargs.get("device")
    back = name == "aten::_to_copy" and asked is not None and torch.device(asked).type == "cpu"
    if given and isinstance(given[0], Elsewhere) and (name in _WAITS or back or _picks_by_mask(name, args)):
        waits.append(_who())
    if asked is not None:
        away = torch.device(asked).type == DEVICE.type
        kwargs = kwargs | {"device": torch.device("cpu")}
    unwrapped = tree_map(lambda t: held(t) if isinstance(t, Tensor) else t, (args, kwargs))
    result = func(*unwrapped[0], **unwrapped[1])
    if func._schema.is_mutable:  # pyright: ignore[reportFunctionMemberAccess]  # the same tensor comes back
        return args[0] if isinstance(result, Tensor) else result
    return tree_map(lambda t: Elsewhere(t) if isinstance(t, Tensor) else t, result) if away else result
