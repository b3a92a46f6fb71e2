"""Arrays on the device leave compiled kernels as they are, wherever numpy has put them."""

import dataclasses

import numpy as np
import pytest
from sensors import bump
from test_simulate import small


@pytest.fixture
def history(variant):
    import drjit as dr

    dr.set_flag(dr.JitFlag.KernelHistory, True)
    dr.kernel_history_clear()
    yield dr.kernel_history
    dr.set_flag(dr.JitFlag.KernelHistory, False)
    dr.kernel_history_clear()


def compiled(history) -> int:
    return sum(not kernel["cache_hit"] for kernel in history() if "cache_hit" in kernel)


def elsewhere(values: np.ndarray, bytes_off: int) -> np.ndarray:
    """A copy so many bytes after an address that is a multiple of 64."""
    raw = np.empty(values.nbytes + 128, np.uint8)
    start = -raw.ctypes.data % 64 + bytes_off
    copied = raw[start : start + values.nbytes].view(values.dtype)
    copied[:] = values
    return copied


def hashes_of(history, convert, values) -> set[int]:
    import drjit as dr

    kept = [elsewhere(values, off) for off in (0, 4, 16, 32, 48)]
    for one in kept:
        assert np.array_equal(np.asarray(dr.square(convert(one))), values**2)
    return {kernel["hash"] for kernel in history() if "hash" in kernel}


@pytest.mark.parametrize("size", [1, 7, 1000])
@pytest.mark.parametrize("kind", ["floats", "doubles", "numbers", "tensor"])
def test_an_address_is_not_in_the_kernel(kind, size, history):
    import mitsuba as mi

    from scenes import arrays

    convert, plain, dtype = {
        "floats": (arrays.floats, mi.Float, np.float32),
        "doubles": (arrays.doubles, mi.Float64, np.float64),
        "numbers": (arrays.numbers, mi.UInt32, np.uint32),
        "tensor": (arrays.tensor, mi.TensorXf, np.float32),
    }[kind]
    values = np.arange(3, size + 3).astype(dtype)
    assert len(hashes_of(history, convert, values)) == 1
    if "llvm" in mi.variant():
        assert len(hashes_of(history, plain, values)) > 1  # what the file is there for


def test_frames_of_a_sensor_with_one_led_compile_nothing_new(history):
    from scenes import SpectralRenderer

    whole = small()
    design = dataclasses.replace(whole, leds=whole.leds[:1])
    renderer = SpectralRenderer(design.sensor(), count=1, at=design.sensor, device="cpu")
    pressed = bump()
    still = np.array(pressed.point_data["displacement"])
    new, between = [], []
    for number in range(8):
        pressed.point_data["displacement"] = (1.0 + 0.1 * number) * still
        between.append([np.empty(101 * k + number, np.uint8) for k in range(50)])  # moves numpy's next arrays
        renderer.render(pressed, quality="preview", seed=number, samples=2**8)
        new.append(compiled(history))
    assert new[2:] == [0] * 6
