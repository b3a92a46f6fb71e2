"""Whose pictures they are: a sensor's own pass, a stranger's do not."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from aliens import aliens
from other_camera import real_camera
from painted_press import painted_light, small

from scenes.camera import expose, mean_counts
from twin.complaint import DesignError
from twin.likeness import fits, learn, likeness
from twin.received import Received
from twin.sound import check_exposure, check_pair, coarse

LEVELS = (1.0, 2.0)
SENSOR = small(rows=246, columns=384, pixel_um=[16.8, 19.6], exposure_ms=1.5)
BLOCK, REFUSED = 12, 0.01


def lights(seed):
    """Light of an inclusion drawn by lot, painted."""
    rng = np.random.default_rng(seed)
    return painted_light(SENSOR, LEVELS, rng.uniform(0.02, 0.5), rng.uniform(-5, 5), rng.uniform(10, 40))


def expected(light):
    wavelength = SENSOR.light.wavelength_nm
    return np.stack([coarse(mean_counts(SENSOR.camera, level, wavelength)) for level in light])


@pytest.fixture(scope="module")
def stored():
    made = [[expected(light) for light in lights(seed)] for seed in range(150)]
    images, references = (np.stack(part) for part in zip(*made, strict=True))
    return learn(images, references, SENSOR.camera, BLOCK, pictures=600)


def judged(stored, received):
    """Likeness of pictures, 0 where they are refused without any model."""
    try:
        for stack in (received.images, received.references):
            for picture in stack:
                check_exposure(picture, received.bits, "picture")
        check_pair(received)
    except DesignError:
        return 0.0
    return likeness(
        stored, *(np.stack([coarse(p) for p in s]) for s in (received.images, received.references))
    )[0]


def own(seed):
    """What the sensor's own camera takes, one exposure each and eight of the references."""
    rng = np.random.default_rng([seed, 1])
    camera, wavelength = SENSOR.camera, SENSOR.light.wavelength_nm
    images, plain = (
        np.stack([expose(camera, level, wavelength, rng, frames=frames) for level in light]).astype(
            np.float32
        )
        for light, frames in zip(lights(seed), (1, 8), strict=True)
    )
    return Received(images, plain, 1, 8, camera.bits, ("a", "b"))


def test_the_sensors_own_pictures_pass(stored):
    """At most 2 % are refused; without an inclusion they are no stranger than with one."""
    found = [judged(stored, own(seed)) for seed in range(1000, 1025)]
    assert np.mean(np.array(found) < REFUSED) <= 0.02
    received = own(2000)
    blank = own(2001).references
    assert judged(stored, replace(received, images=np.rint(blank), references=received.references)) > 0.05


def test_another_camera_a_little_off_passes(stored):
    """Other noise, other pixels, and 1 % off in place, size and angle."""
    found = [
        judged(stored, real_camera(SENSOR, *lights(seed), seed, reference_frames=8))
        for seed in range(1100, 1112)
    ]
    assert np.mean(np.array(found) < REFUSED) <= 0.02


def test_a_hundred_aliens_are_refused(stored):
    """At least 95 of them; of each family most."""
    families, refused = Counter(), Counter()
    for alien in aliens(own(1205)):
        families[alien.family] += 1
        refused[alien.family] += judged(stored, alien.received) < REFUSED
    assert families.total() == 100 and len(families) == 14
    assert refused.total() >= 95, families - refused
    assert all(2 * refused[family] > families[family] for family in families)


def test_arrays_of_another_shape_are_seen(stored):
    shape = (2, *stored["scale_tared"].shape[1:])
    assert fits(stored, shape) and not fits(stored, (3, *shape[1:])) and not fits({}, shape)
    assert not any(fits({**stored, name: stored[name][:0]}, shape) for name in stored)


def test_why_is_said(stored):
    received = own(1300)
    pictures = [np.stack([coarse(p) for p in s]) for s in (received.images, received.references)]
    assert "usual from" in likeness(stored, *pictures)[1]
    share, why = likeness(stored, 3 * pictures[0], 3 * pictures[1])
    assert share == 0.0 and "times as far as usual from" in why
    assert likeness(stored, np.full_like(pictures[0], np.nan), pictures[1])[0] == 0.0
