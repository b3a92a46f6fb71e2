"""Choose what Mitsuba runs on, once, before anything imports it.

Mitsuba's classes bind to the variant that is active when they are defined, so a process keeps the first
choice it made.
"""

from __future__ import annotations

import ctypes
import os
import platform
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from scenes import llvm

VARIANTS = {"cuda": "cuda_ad_mono", "cpu": "llvm_ad_mono"}
"""Mitsuba's variant for each device: one wavelength at a time, differentiable."""

POLARISED = {device: f"{variant}_polarized" for device, variant in VARIANTS.items()}
"""The same, in which light has a state of polarisation."""


class BackendError(ValueError):
    """Mitsuba cannot run on what was asked for; the message is one line and says what to do."""


def use(device: str = "auto") -> str:
    """Make Mitsuba ready: `import mitsuba` after this call has its variant set.

    Parameters
    ----------
    device : {"auto", "cpu", "cuda"}
        "auto" takes a CUDA GPU where there is one that can trace rays, and the CPU elsewhere.

    Returns
    -------
    str
        Name of the active variant, "cuda_ad_mono" or "llvm_ad_mono".

    Raises
    ------
    BackendError
        Unknown device; no GPU for "cuda"; no usable LLVM for the CPU; another variant is active already.
    """
    return _settle(device, VARIANTS)


def use_polarised(device: str = "auto") -> str:
    """Make Mitsuba's polarised variant ready, as `use` does the plain one: for a process that only compares
    the two kinds of light (`polarised`), since everything else refuses to run in it."""
    return _settle(device, POLARISED)


def _settle(device: str, variants: dict[str, str]) -> str:
    if device not in ("auto", *variants):
        raise BackendError(f"device: received {device!r}; allowed: 'auto', 'cpu', 'cuda'")
    active = _active()
    if active:
        if active not in variants.values() or device not in ("auto", _device(active, variants)):
            raise BackendError(
                f"device: received {device!r}, but this process already runs Mitsuba's {active}; "
                "start a new process to change it"
            )
        return active
    # First of all, and for the GPU too: the first variant that is tried, even in vain, settles the LLVM.
    library = llvm.find()
    if not library.fault:
        os.environ["DRJIT_LIBLLVM_PATH"] = str(library.path)
    if device != "cpu":
        fault = _cuda_fault() or _activate(variants["cuda"])
        if not fault:
            return variants["cuda"]
        if device == "cuda":
            raise BackendError(f"device: received 'cuda', but {fault}; allowed here: 'auto', 'cpu'")
    if library.fault:
        raise BackendError(f"device: no usable LLVM for Mitsuba on the CPU ({library.fault}); {llvm.ADVICE}")
    fault = _activate(variants["cpu"])
    if fault:
        raise BackendError(f"device: Mitsuba does not start on the CPU ({fault}); {llvm.ADVICE}")
    return variants["cpu"]


def threads(count: int) -> None:
    """Let Dr.Jit's CPU kernels run on `count` threads (at least 1). Call after `use`."""
    if count < 1:
        raise BackendError(f"threads: received {count}; allowed: 1 or more")
    import drjit

    drjit.set_thread_count(count)


@contextmanager
def flushing() -> Iterator[None]:
    """Let this thread take subnormal numbers for zero, as Dr.Jit's own threads do.

    Where there is one thread only, this one runs the kernels; last digits are then those of several.
    """
    if platform.machine() != "x86_64" or not sys.platform.startswith("linux"):
        yield
        return
    libm = ctypes.CDLL("libm.so.6")
    before, flushed = ((ctypes.c_uint32 * 8)() for _ in range(2))  # fenv_t; MXCSR is its last word
    libm.fegetenv(before)
    libm.fegetenv(flushed)
    flushed[7] |= 0x8040  # FTZ and DAZ
    libm.fesetenv(flushed)
    try:
        yield
    finally:
        libm.fesetenv(before)


def _activate(variant: str) -> str:
    """Import Mitsuba and set its variant; returns what went wrong, in one line, or nothing."""
    fault = llvm.load_atomic()
    if fault:
        return fault
    try:
        import mitsuba

        mitsuba.set_variant(variant)
    except (ImportError, RuntimeError) as error:
        return str(error).strip().splitlines()[0].rstrip(".")
    return ""


def _active() -> str | None:
    """Variant that this process runs already."""
    mitsuba = sys.modules.get("mitsuba")
    variant = mitsuba.variant() if mitsuba else None
    return str(variant) if variant else None


def _device(variant: str, variants: dict[str, str]) -> str:
    return next(device for device, name in variants.items() if name == variant)


def _cuda_fault() -> str:
    """Why no CUDA GPU can be used here; empty where one can. Asks the driver itself, which is quick and
    harmless."""
    try:
        driver = ctypes.CDLL("libcuda.so.1")
    except OSError:
        return "there is no NVIDIA driver (libcuda.so.1)"
    count = ctypes.c_int(0)
    if driver.cuInit(0) != 0 or driver.cuDeviceGetCount(ctypes.byref(count)) != 0 or count.value < 1:
        return "the NVIDIA driver shows no GPU"
    try:
        ctypes.CDLL(os.environ.get("DRJIT_LIBOPTIX_PATH") or "libnvoptix.so.1")
    except OSError:
        return "the NVIDIA driver lacks its ray tracing library (libnvoptix.so.1)"
    return ""
