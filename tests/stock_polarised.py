"""Light through dielectrics by Mitsuba's own `path` and materials, and by our walk: a process of its own.

    python tests/stock_polarised.py polarised|plain PATH_SAMPLES RAYS

The contact is the bare face between guide and tissue (full contact), and what passes it far from the LEDs is
counted: by `path` from an irradiance meter behind it; along rays from the LEDs, of which Mitsuba's materials
make what they will ("stock"); and by our walk. Prints a JSON line of means and standard errors, W; without
samples, `path` is left out.
"""

from __future__ import annotations

import dataclasses
import json
import sys
from typing import Any

import numpy as np
from sensors import HALF_MM, paper_sensor

from scenes import backend
from scenes.sensor import Glass, Guide, Led, Sensor
from scenes.skin import Skin, Tissue

RUNS = 8
FAR_MM = -2.5
"""What lies farther from the LEDs than this x is counted."""


def sensor() -> Sensor:
    """LEDs in air before a thin guide whose contact polarises light far more than a real one's."""
    places = np.linspace(-10.0, 10.0, 10)
    leds = [Led(side="+x", along_mm=at, z_mm=-1.0, diameter_mm=1.8, flux_W=0.1) for at in places]
    return dataclasses.replace(
        paper_sensor(),
        guide=Guide(width_mm=2 * HALF_MM, thickness_mm=2.0, refractive_index=1.5),
        glass=Glass(refractive_index=1.6),
        leds=tuple(leds),
        skin=Skin(contact="full"),
        tissue=Tissue(refractive_index=3.0),
    )


def scene(lit: Sensor) -> Any:
    """`build.describe`, with a bare face for a contact and a meter behind it."""
    import mitsuba as mi

    from scenes import build

    turn = mi.ScalarTransform4f().rotate([1, 0, 0], 180).scale([HALF_MM, HALF_MM, 1])
    indices = {"int_ior": lit.tissue.refractive_index, "ext_ior": lit.guide.refractive_index}
    contact = {"type": "rectangle", "to_world": turn, "bsdf": {"type": "dielectric", **indices}}
    found: dict[str, Any] = build.describe(lit, contact)
    del found["camera"]
    far = mi.ScalarTransform4f().translate([(FAR_MM - HALF_MM) / 2, 0, 0.02])  # rays start 1 µm off
    film = {"type": "hdrfilm", "width": 1, "height": 1, "rfilter": {"type": "box"}}
    found["meter"] = {
        "type": "rectangle",
        "to_world": far.scale([(FAR_MM + HALF_MM) / 2 / HALF_MM, 1, 1]) @ turn,
        "bsdf": {"type": "diffuse", "reflectance": {"type": "uniform", "value": 0.0}},
        "sensor": {"type": "irradiancemeter", "film": {**film, "pixel_format": "luminance"}},
    }
    return mi.load_dict(found, optimize=False)


def by_path(lit: Sensor, samples: int) -> list[float]:
    """What passes, W, in each run."""
    import mitsuba as mi

    loaded, area = scene(lit), 2 * HALF_MM * (FAR_MM + HALF_MM)
    path = mi.load_dict({"type": "path", "max_depth": 200, "rr_depth": 12})
    runs = [mi.render(loaded, integrator=path, spp=samples // RUNS, seed=k) for k in range(RUNS)]
    return [float(np.asarray(run).ravel()[0]) * area for run in runs]


def by_materials(lit: Sensor, rays: int) -> list[float]:
    """The same by Mitsuba's dielectrics along rays from the LEDs, states and bases being Mitsuba's."""
    import drjit as dr
    import mitsuba as mi

    from scenes import trace

    loaded, context = scene(lit), mi.BSDFContext(mi.TransportMode.Importance)
    meter = next(shape for shape in loaded.shapes() if shape.id() == "meter")
    each = rays // RUNS
    number = dr.arange(mi.UInt32, each) % len(lit.leds)

    def going(ray, light, counted, bounce, alive, random):  # type: ignore[no-untyped-def]
        return alive

    def step(ray, light, counted, bounce, alive, random):  # type: ignore[no-untyped-def]
        si = loaded.ray_intersect(ray, alive)
        alive = alive & si.is_valid()
        arrives = alive & (si.shape == mi.ShapePtr(meter))
        intensity = mi.unpolarized_spectrum(light)[0]
        counted += dr.select(arrives, intensity, 0.0)
        sample1, sample2 = random.next_float32(), mi.Point2f(random.next_float32(), random.next_float32())
        sampled, weight = si.bsdf().sample(context, si, sample1, sample2, alive)
        light = si.to_world_mueller(weight, -si.wi, sampled.wo) @ light if polarised else weight * light
        ray = si.spawn_ray(si.to_world(sampled.wo))
        alive = alive & ~arrives & (mi.unpolarized_spectrum(light)[0] != 0.0) & (bounce < 500)
        return ray, light, counted, bounce + 1, alive, random

    polarised, found = "polarized" in mi.variant(), []
    for k in range(RUNS):
        random = mi.PCG32(size=each, initstate=dr.opaque(mi.UInt64, k + 1))
        ray = trace.emit(lit, number, [random.next_float32() for _ in range(4)])
        begin = (ray, mi.Spectrum(1.0), mi.Float(0.0), mi.UInt32(0), mi.Bool(True), random)
        counted = dr.while_loop(begin, going, step)[2]
        found.append(float(dr.mean(counted)[0]) * sum(led.flux_W for led in lit.leds))
    return found


def by_walk(lit: Sensor, rays: int) -> list[list[float]]:
    """The same by our walk, unpolarised and polarised."""
    from scenes import surface
    from scenes.polarised import Polarised

    ours, each = Polarised(lit, surface.flat(2 * HALF_MM, 1.0)), rays // RUNS // len(lit.leds)
    found = [ours.entering(each, k) for k in range(RUNS)]
    cells = round((0.5 + FAR_MM / HALF_MM / 2) * found[0].shape[-1])
    return [one[..., :cells].sum(axis=(1, 2, 3)).tolist() for one in found]


def main() -> None:
    kind, samples, rays = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
    (backend.use_polarised if kind == "polarised" else backend.use)("cpu")
    lit = sensor()
    found = {"materials": np.array(by_materials(lit, rays))}
    found["unpolarised"], found["polarised"] = np.array(by_walk(lit, rays)).T
    if samples:
        found["path"] = np.array(by_path(lit, samples))
    print(json.dumps({k: (v.mean(), v.std(ddof=1) / np.sqrt(RUNS)) for k, v in found.items()}))


if __name__ == "__main__":
    main()
