"""A hundred pairs of pictures that no model of a sensor may answer, made from one pair that it may.

Most come as a camera would deliver them: picture and reference have the same pixel pattern and their own
noise, so that only what they show gives them away. The same pair and seed give the same hundred.
"""

from __future__ import annotations

import string
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray
from other_camera import moved
from PIL import Image, ImageDraw, ImageFont
from scipy.ndimage import gaussian_filter, zoom

from twin.received import Received

Float = NDArray[np.float64]


@dataclass(frozen=True)
class Alien:
    """A pair that is not what it seems."""

    family: str
    name: str
    received: Received


def aliens(pair: Received, seed: int = 0) -> Iterator[Alien]:
    """Yield a hundred aliens of a valid pair, without colour, of two press levels or more."""
    scene = _Scene(pair, seed)
    for family in (
        _views,
        _lights,
        _textures,
        _texts,
        _boards,
        _ramps,
        _blobs,
        _noises,
        _turns,
        _ranges,
        _mixed,
    ):
        yield from family(scene)


class _Scene:
    """What the pair shows without its noise, and a camera to show other things with."""

    def __init__(self, pair: Received, seed: int) -> None:
        self.pair, self.rng = pair, np.random.default_rng(seed)
        self.images, self.plain = (
            np.stack([gaussian_filter(level, 3.0) for level in stack.astype(np.float64)])
            for stack in (pair.images, pair.references)
        )
        self.shape = self.images.shape[1:]
        self.pattern = 1.0 + 0.01 * self.rng.standard_normal(self.shape)
        y, x = np.indices(self.shape)
        # -1 to 1 along the picture's width, the same scale along y
        self.x = (2 * x - self.shape[1] + 1) / self.shape[1]
        self.y = (2 * y - self.shape[0] + 1) / self.shape[1]

    def alien(self, family: str, name: str, images: Float, plain: Float) -> Alien:
        """Both as the camera takes them."""
        frames, several = self.pair.frames, self.pair.reference_frames
        shot = self._exposed(images, frames), self._exposed(plain, several)
        return self.given(family, name, *shot)

    def given(self, family: str, name: str, images: Float, references: Float) -> Alien:
        """Both as they are."""
        counts = (np.asarray(images, np.float32), np.asarray(references, np.float32))
        return Alien(family, name, replace(self.pair, images=counts[0], references=counts[1]))

    def _exposed(self, mean: Float, frames: int) -> Float:
        top = 2**self.pair.bits - 1
        light = np.clip(mean, 0, 4 * top) * self.pattern
        per_count = 45_000 / top  # electrons
        sd = np.sqrt((light / per_count + 0.1) / frames)
        return np.clip(
            np.rint((light + sd * self.rng.standard_normal(light.shape)) * frames) / frames, 0, top
        )


def _views(scene: _Scene) -> Iterator[Alien]:
    """Other fields of view (8) and cameras beside the sensor's middle (4)."""
    for size in (0.5, 0.6, 0.7, 0.8, 1.25, 1.5, 2.0, 3.0):
        see = partial(moved, shift=(0.0, 0.0), scale=size, turn=0.0)
        yield scene.alien("field of view", f"magnified {size:g}", see(scene.images), see(scene.plain))
    quarter = 0.25 * scene.shape[1]
    for step in ((quarter, 0.0), (-quarter, 0.0), (0.0, quarter), (quarter, -quarter)):
        see = partial(moved, shift=step, scale=1.0, turn=0.0)
        yield scene.alien("field of view", f"shifted {step}", see(scene.images), see(scene.plain))


def _lights(scene: _Scene) -> Iterator[Alien]:
    """Light from elsewhere: one side (4), spots at the sides (2), a lamp in the middle, rings (8 in all)."""
    x, y = scene.x, scene.y
    factors = {f"from one side {k}": np.exp(1.2 * (a * x + b * y)) for k, (a, b) in enumerate(_SIDES)}
    spot = sum(np.exp(-((x - a) ** 2 + (y - 0.64 * b) ** 2) / 0.02) for a, b in _SIDES)
    factors |= {
        "spots": 1 + 2 * spot,
        "strong spots": 0.3 + 6 * spot,
        "lamp in the middle": 0.3 + 1.5 * np.exp(-(x**2 + y**2) / 0.1),
        "rings": 1 + 0.3 * np.cos(20 * np.hypot(x, y)),
    }
    for name, factor in factors.items():
        yield scene.alien("other LEDs", name, factor * scene.images, factor * scene.plain)


_SIDES = ((1, 0), (-1, 0), (0, 1), (0, -1))


def _over_levels(scene: _Scene, picture: Float) -> Float:
    """One picture of 0 to 1 as bright as the references are, at every level."""
    lows, highs = scene.plain.min(axis=(1, 2)), scene.plain.max(axis=(1, 2))
    return np.stack([low + (high - low) * picture for low, high in zip(lows, highs, strict=True)])


def _instead(scene: _Scene, family: str, name: str, picture: Float, other: Float) -> Iterator[Alien]:
    """A picture before the sensor's own reference, and two pictures for a pair."""
    yield scene.alien(family, f"{name}, true reference", _over_levels(scene, picture), scene.plain)
    yield scene.alien(family, name, _over_levels(scene, picture), _over_levels(scene, other))


def _textures(scene: _Scene) -> Iterator[Alien]:
    """Photograph-like textures, of amplitude 1/f to 1/f² (12)."""
    for power in (1.0, 1.2, 1.4, 1.6, 1.8, 2.0):
        pictures = (_texture(scene, power), _texture(scene, power))
        yield from _instead(scene, "photograph", f"1/f^{power:g}", *pictures)


def _texture(scene: _Scene, power: float) -> Float:
    rows, columns = scene.shape
    away = np.hypot(np.fft.fftfreq(rows)[:, None], np.fft.rfftfreq(columns)[None])
    away[0, 0] = np.inf
    waves = scene.rng.standard_normal((2, *away.shape))
    picture = np.fft.irfft2((waves[0] + 1j * waves[1]) * away**-power, scene.shape)
    low, high = np.quantile(picture, [0.01, 0.99])
    return np.clip((picture - low) / (high - low), 0, 1)


def _texts(scene: _Scene) -> Iterator[Alien]:
    """Printed pages (6)."""
    for size in (10, 20, 40):
        yield from _instead(scene, "text", f"{size} pixels high", _text(scene, size), _text(scene, size))


def _text(scene: _Scene, size: int) -> Float:
    rows, columns = scene.shape
    page = Image.new("L", (columns, rows), 255)
    draw, font = ImageDraw.Draw(page), ImageFont.load_default(size)
    letters = np.array(list(string.ascii_letters + "     "))
    for line in range(0, rows, round(1.3 * size)):
        draw.text((5, line), "".join(scene.rng.choice(letters, columns // max(size // 2, 1))), 0, font)
    return np.asarray(page, np.float64) / 255


def _boards(scene: _Scene) -> Iterator[Alien]:
    """Checkerboards (6)."""
    for cells in (4, 10, 30):
        board = (np.floor(scene.x * cells / 2) + np.floor(scene.y * cells / 2)) % 2
        yield from _instead(scene, "checkerboard", f"{cells} across", board, 1 - board)


def _ramps(scene: _Scene) -> Iterator[Alien]:
    """Gradients (6)."""
    across = {"x": scene.x, "y": scene.y, "both": scene.x + scene.y}
    for name, ramp in across.items():
        ramp = (ramp - ramp.min()) / (ramp.max() - ramp.min())
        yield from _instead(scene, "gradient", name, ramp, ramp[::-1, ::-1])


def _blobs(scene: _Scene) -> Iterator[Alien]:
    """What is no inclusion, under a true reference (8)."""
    x, y = scene.x, scene.y
    r = np.hypot(x, y)
    corner = np.hypot(x - 0.9, y - 0.55)
    shapes = {
        "shadow": -0.4 * np.exp(-(r**2) / 0.05),
        "square": 0.3 * ((abs(x) < 0.2) & (abs(y) < 0.2)),
        "ring": 0.3 * np.exp(-((r - 0.4) ** 2) / 0.002),
        "lamp in a corner": 0.5 * np.exp(-(corner**2) / 0.02),
        "cross": 0.3 * ((abs(x) < 0.03) | (abs(y) < 0.03)),
        "two": 0.3 * (np.exp(-((x - 0.5) ** 2 + y**2) / 0.01) + np.exp(-((x + 0.5) ** 2 + y**2) / 0.01)),
        "sticker": -0.5 * ((abs(x - 0.4) < 0.1) & (abs(y + 0.2) < 0.06)),
        "hair": -0.3 * np.exp(-((y - 0.3 * np.sin(4 * x)) ** 2) / 2e-4),
    }
    for name, factor in shapes.items():
        yield scene.alien("no inclusion", name, scene.plain * (1 + factor), scene.plain)


def _noises(scene: _Scene) -> Iterator[Alien]:
    """White noise and salt and pepper, instead of pictures and on them (8)."""
    top, rng = 2**scene.pair.bits - 1, scene.rng
    for name, plain in (("for both", None), ("true reference", scene.pair.references)):
        pictures = rng.uniform(0, top, (2, *scene.images.shape)).round()
        other = pictures[1] if plain is None else plain
        yield scene.given("noise", f"white, {name}", pictures[0], other)
    for name, amount in (("a little", 0.03), ("strong", 0.15)):
        noise = amount * top * rng.standard_normal(scene.images.shape)
        noisy = np.clip(np.rint(scene.pair.images + noise), 0, top)
        yield scene.given("noise", f"white, {name}, on the picture", noisy, scene.pair.references)
    for share in (0.003, 0.01, 0.05, 0.3):
        hit = rng.random(scene.images.shape)
        salted = np.where(hit < share / 2, 0, np.where(hit > 1 - share / 2, top, scene.pair.images))
        yield scene.given("noise", f"salt and pepper, {100 * share:g} %", salted, scene.pair.references)


def _turns(scene: _Scene) -> Iterator[Alien]:
    """Picture or reference turned: mirrored, upside down, both, by a little (8), by 90 degrees (4).

    A pair that is turned as a whole is no alien where the sensor is symmetric: it is another valid pair.
    """
    images, plain = scene.pair.images, scene.pair.references
    turns = {
        "mirrored": (slice(None), slice(None), slice(None, None, -1)),
        "upside down": (slice(None), slice(None, None, -1)),
        "by 180 degrees": (slice(None), slice(None, None, -1), slice(None, None, -1)),
    }
    for name, turn in turns.items():
        yield scene.given("wrong flip", f"picture {name}", images[turn], plain)
        yield scene.given("wrong flip", f"reference {name}", images, plain[turn])
    for angle in (0.15, -0.3):
        yield scene.alien(
            "wrong flip", f"picture by {angle:g} rad", moved(scene.images, (0, 0), 1, angle), scene.plain
        )
    square = scene.shape[0] / scene.shape[1], scene.shape[1] / scene.shape[0]
    for times in (1, 3):
        turned = [
            np.stack([zoom(np.rot90(level, times), square, order=1) for level in stack])
            for stack in (scene.images, scene.plain)
        ]
        yield scene.alien("wrong flip", f"both by {90 * times} degrees", *turned)
        yield scene.alien("wrong flip", f"picture by {90 * times} degrees", turned[0], scene.plain)


def _ranges(scene: _Scene) -> Iterator[Alien]:
    """Saturated (6), dark (4), and other gains and gammas (5)."""
    top = 2**scene.pair.bits - 1
    for factor in (3.0, 5.0, 10.0):
        yield scene.alien("saturated", f"{factor:g} times", factor * scene.images, factor * scene.plain)
        yield scene.alien("saturated", f"picture {factor:g} times", factor * scene.images, scene.plain)
    for factor in (0.3, 0.1, 0.02, 0.0):
        yield scene.alien("dark", f"{factor:g} times", factor * scene.images, factor * scene.plain)
    for factor in (0.6, 0.75, 1.5):
        yield scene.alien("other gain", f"{factor:g} times", factor * scene.images, factor * scene.plain)
    for gamma in (0.45, 2.2):
        bent = (top * (stack / top) ** gamma for stack in (scene.images, scene.plain))
        yield scene.alien("other gain", f"gamma {gamma:g}", *bent)


def _mixed(scene: _Scene) -> Iterator[Alien]:
    """Picture and reference exchanged or the same (3), levels mixed up (4)."""
    images, plain = scene.pair.images, scene.pair.references
    yield scene.given("exchanged", "picture and reference", plain, images)
    yield scene.given("exchanged", "reference twice", plain, plain)
    yield scene.given(
        "exchanged", "at one level", np.stack([*plain[:1], *images[1:]]), np.stack([*images[:1], *plain[1:]])
    )
    yield scene.given("other level", "references one on", images, np.roll(plain, 1, axis=0))
    yield scene.given("other level", "references back to front", images, plain[::-1])
    yield scene.given("other level", "all back to front", images[::-1], plain[::-1])
    yield scene.given(
        "other level", "one level for all", *(np.repeat(s[-1:], len(s), axis=0) for s in (images, plain))
    )
