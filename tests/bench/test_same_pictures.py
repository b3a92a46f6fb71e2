"""Full solves with standard light beside the emulator with learned light: the same specimens, drawn twice.

twin corpus plan phantoms --seed 5 --paths 4194304 --out corpora/phantoms
twin corpus plan phantoms --seed 5 --mechanics emulator --traced tsis --light preview --out corpora/emulated
twin corpus run corpora/phantoms; twin corpus run corpora/emulated
TWIN_SOLVED=corpora/phantoms TWIN_EMULATED=corpora/emulated \\
    pytest -m slow -s tests/bench/test_same_pictures.py
"""

import os

import numpy as np
import pytest
from numpy.typing import NDArray

import twin

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(  # one alone is an error
        not {"TWIN_SOLVED", "TWIN_EMULATED"} & set(os.environ), reason="needs TWIN_SOLVED and TWIN_EMULATED"
    ),
]
BLOCK = 12  # pixels
COUNTS, PERCENT = 0.2, 0.1  # rms that the tared pictures, in blocks, and the pressures may be apart


def blocks(image: NDArray[np.floating]) -> NDArray[np.float64]:
    """Means of blocks of 12 x 12 pixels."""
    h, w = (n // BLOCK for n in image.shape)
    cut = np.asarray(image, np.float64)[: h * BLOCK, : w * BLOCK]
    return np.asarray(cut.reshape(h, BLOCK, w, BLOCK).mean(axis=(1, 3)))


def test_the_same_specimens_look_the_same() -> None:
    solved, emulated = (twin.Corpus(os.environ[name]) for name in ("TWIN_SOLVED", "TWIN_EMULATED"))
    for drawn in ("size_mm", "specimen.modulus_kPa", "camera.gain_e_per_dn"):
        np.testing.assert_array_equal(*(corpus.table[drawn] for corpus in (solved, emulated)))
    print("sample, level | tared, counts: largest; rms and largest difference | pressure, rms difference, %")
    apart, pressed = [], []
    for sample in map(int, solved.samples):
        for level in range(solved.levels):
            lit, plain, pressure = [], [], []
            for corpus in (solved, emulated):
                lit.append(blocks(corpus.radiance(sample, level).sum(0)))
                plain.append(blocks(corpus.reference_radiance(sample, level).sum(0)))
                pressure.append(blocks(corpus.field(sample, level, "pressure")))
            counts = blocks(solved.image(sample, level)).sum() / lit[0].sum()
            tared = [counts * (a - b) for a, b in zip(lit, plain, strict=True)]
            off = tared[0] - tared[1]
            apart.append(float(np.sqrt((off**2).mean())))
            pressed.append(100 * float(np.sqrt(((pressure[0] / pressure[1] - 1) ** 2).mean())))
            print(
                f"{sample:3d} {level} | {tared[0].max():5.1f}; {apart[-1]:.2f} {np.abs(off).max():.2f} "
                f"| {pressed[-1]:.2f}"
            )
    print(f"rms of all: {np.sqrt(np.mean(np.square(apart))):.2f} counts, pressure {np.mean(pressed):.2f} %")
    assert max(apart) < COUNTS
    assert max(pressed) < PERCENT
