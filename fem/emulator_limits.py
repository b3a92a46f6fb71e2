"""What an emulator refuses: other sensors and specimens than it learned, and what lies outside its
ranges."""

from __future__ import annotations

from fem.model import Inclusion, NotModelled, Probe, Slab
from fem.sampling import Plan, clearance


def check(
    plan: Plan,
    probe: Probe,
    slab: Slab,
    inclusion: Inclusion | None,
    mechanics: str,
    tilt: tuple[float, float],
    position: tuple[float, float],
) -> None:
    """Refuse what an emulator was not built for (NotModelled), and what lies outside its ranges
    (ValueError)."""
    own = plan.slab(slab.thickness_mm, slab.modulus_kPa)
    same = [*_parts(probe, plan.probe), ("mechanics", mechanics, plan.mechanics)]
    same += [(f"slab.{k}", getattr(slab, k), getattr(own, k)) for k in ("width_mm", "poisson", "sides")]
    same += [("tilt", tuple(tilt), (0.0, 0.0)), ("position", tuple(position), (0.0, 0.0))]
    if inclusion is not None:
        same.append(("inclusion.poisson", inclusion.poisson, plan.inner_poisson))
        same.append(("inclusion.stretch", tuple(inclusion.stretch), (1.0, 1.0, 1.0)))
    for name, received, allowed in same:
        if received != allowed:
            raise NotModelled(
                f"{name}: received {received}; not in this emulator, which was built for {allowed}"
            )
    ranges = plan.ranges
    within("slab.thickness_mm", slab.thickness_mm, ranges.thickness_mm, "mm")
    within("slab.modulus_kPa", slab.modulus_kPa, ranges.tissue_kPa, "kPa")
    if inclusion is None:
        return
    within("inclusion.size", inclusion.size, ranges.size_mm, "mm")
    within("inclusion.depth", inclusion.depth, ranges.depth_mm, "mm")
    within("inclusion.modulus", inclusion.modulus, ranges.modulus_kPa, "kPa")
    for part in inclusion.offset:
        within("inclusion.offset", part, (-ranges.offset_mm, ranges.offset_mm), "mm")
    room = clearance(inclusion.size, inclusion.depth, slab.thickness_mm)
    if room < 0:
        reach = inclusion.size + inclusion.depth
        raise ValueError(
            f"inclusion.depth + inclusion.size: received {reach:g} mm; allowed in this emulator up to "
            f"{reach + room:g} mm in a slab of {slab.thickness_mm:g} mm"
        )


def _parts(probe: Probe, own: Probe) -> list[tuple[str, object, object]]:
    """Name, value and known value of each property of a probe."""
    names = ("width_mm", "dome_radius_mm")
    found: list[tuple[str, object, object]] = [
        (f"probe.{k}", getattr(probe, k), getattr(own, k)) for k in names
    ]
    found.append(("probe.layers", len(probe.layers), len(own.layers)))
    for number, pair in enumerate(zip(probe.layers, own.layers, strict=False)):
        found += [(f"probe.layers.{number}.{k}", *(getattr(la, k) for la in pair)) for k in vars(pair[0])]
    return found


def within(name: str, value: float, allowed: tuple[float, float], unit: str) -> None:
    """Raise ValueError, in one line, for a value outside of what is allowed."""
    low, high = allowed
    slack = 1e-9 * max(abs(low), abs(high))
    if not low - slack <= value <= high + slack:
        raise ValueError(
            f"{name}: received {value:g} {unit}; allowed in this emulator {low:g} to {high:g} {unit}"
        )
