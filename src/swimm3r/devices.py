"""Devices: the CPU, or an accelerator where there is one."""

import importlib.util
import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import torch

from swimm3r.errors import DeviceError

log = logging.getLogger(__name__)

CPU = torch.device("cpu")


def chosen(name: str, accelerators: Sequence[str] = ("cuda", "mps"), option: str = "--device") -> torch.device:
    """The device of that name; "auto" is the first of `accelerators` that is here, else the processor.

    Raises DeviceError for one that is not here; `option` is how the user names it.
    """
    here = {"cpu": True, "cuda": torch.cuda.is_available(), "mps": torch.backends.mps.is_available()}
    if name == "auto":
        name = next((accelerator for accelerator in accelerators if here[accelerator]), "cpu")
    if not here[name]:
        raise DeviceError(
            f"there is no {name} device on this computer",
            cause="no accelerator, no driver for it, or a PyTorch without its support (swimm3r doctor shows which)",
            hint=f"{option} auto",
        )
    return torch.device(name)


def for_maps(name: str = "auto") -> torch.device:
    """The device that trains and renders maps: CUDA with NVIDIA Warp, else the CPU.

    Raises DeviceError where "cuda" was asked for and a part of it is missing; "auto" says so in the log.
    """
    return _with_warp(name, "maps", "--map-device")


def for_depth(name: str = "auto") -> torch.device:
    """The device of the plane sweep: CUDA with NVIDIA Warp, else the CPU; errors as of `for_maps`."""
    return _with_warp(name, "dense depth", "--depth.device")


def _with_warp(name: str, what: str, option: str) -> torch.device:
    device = chosen(name, ("cuda",), option)
    if device.type == "cuda" and importlib.util.find_spec("warp") is None:
        if name == "cuda":
            raise without_warp(f"{option} cpu")
        log.warning("there is a GPU, but Warp is missing, which %s needs: pip install 'swimm3r[cuda]'", what)
        return CPU
    return device


def without_warp(instead: str) -> DeviceError:
    """The error for a requested GPU whose kernels cannot run; `instead` names the alternative."""
    return DeviceError(
        "the kernels for the GPU need NVIDIA Warp, which is not installed",
        cause="Swimm3R was installed without its cuda extra",
        hint=f"pip install 'swimm3r[cuda]', or {instead}",
    )


@contextmanager
def memory_for(what: str, hint: str) -> Iterator[None]:
    """Work that may need more memory than the accelerator has, and what to do then. Raises DeviceError."""
    try:
        yield
    except torch.OutOfMemoryError as error:
        raise DeviceError(
            f"the accelerator's memory is too small for {what}", cause=str(error).splitlines()[0], hint=hint
        ) from error


@contextmanager
def torch_threads(count: int | None = None) -> Iterator[None]:
    """Torch with that many threads inside, and with as many as before afterwards.

    None changes nothing at first: around code whose own kernels set OpenMP's number of threads, which torch shares.
    """
    before = torch.get_num_threads()
    if count is not None:
        torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)
