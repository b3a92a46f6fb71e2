"""The posterior by rendering, on a sensor so simple that its posterior can be summed up by brute force."""

from collections.abc import Mapping
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import linalg, optimize

from twin import fitting, refining, valley
from twin.fitting import Prior
from twin.study import PARAMETERS

RANGES = np.array([[2.0, 13.0], [4.0, 12.0], [40.0, 120.0], [-2.0, 2.0], [-2.0, 2.0]])
PRIOR = Prior(RANGES, ("gain",), np.zeros(1), np.full((1, 1), 0.02))
NOISE = 0.03
K = 8


def truth(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Pictures (..., K): d³ times a contrast that saturates, in parts that tell depth, offsets and gain."""
    d, h, e, ox, oy, t = np.moveaxis(np.asarray(x, float), -1, 0)
    signal = 0.02 * d**3 * (e / 20.0 - 1.0) / (e / 20.0 + 1.5) * (1.0 + 0.02 * t)
    parts = [signal / h**2 * 10, signal / h**3 * 80, signal * ox / h, signal * oy / h, 0.2 * d + 0.001 * e]
    return np.stack([*parts, signal * 0.1, 5.0 * (1.0 + 0.02 * t), 0.1 * h], axis=-1)


def light_map(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """The same, off by more than the noise, and by other amounts elsewhere, along the valley too."""
    along = np.stack([np.cos(np.asarray(x)[..., 2] / 40.0 + n) for n in range(K)], axis=-1)
    return truth(x) * 1.01 + 0.1 + 0.002 * np.asarray(x)[..., :1] + 0.1 * along


class Features:
    """Pictures are features."""

    shape = (K, 1, 1, 1)
    spread = np.ones(K)

    def __call__(self, pictures: NDArray[Any]) -> NDArray[Any]:
        return np.asarray(pictures).reshape(-1, K)


@pytest.fixture(autouse=True)
def simple(monkeypatch: pytest.MonkeyPatch) -> None:
    def expected(chain: Any, prior: Prior, many: Any, near: Any = None) -> NDArray[Any]:
        seen = light_map(np.array(many)).reshape(-1, *Features.shape)
        return seen if near is None else seen + near.of(many)

    def covariance(
        chain: Any, features: Any, seen: Any, gain: Any, frames: float, pattern: Any, rounded: bool = False
    ) -> Any:
        return np.eye(K) * NOISE**2 / frames

    for module in (fitting, refining, valley):
        monkeypatch.setattr(module, "covariance", covariance)
    for module in (fitting, refining):
        monkeypatch.setattr(module, "expected", expected)


CHAIN: Any = SimpleNamespace(
    gain=lambda values: 1.0, design=SimpleNamespace(specimen=SimpleNamespace(modulus_kPa=20.0))
)


def render(values: Mapping[str, float]) -> NDArray[np.float32]:
    x = np.array([*(values[name] for name in PARAMETERS), values["gain"] / 0.02])
    return truth(x).reshape(Features.shape).astype(np.float32)


def refined(x: NDArray[np.float64], frames: float, seed: int, error: float = 0.15) -> refining.Refined:
    noise = NOISE / np.sqrt(frames) * np.random.default_rng(seed).standard_normal(K)
    start = np.array([x[0] + 0.4, x[1] - 0.3, 80.0, 0.0, 0.0, 0.0])
    features: Any = Features()
    wide = np.eye(K) * error**2
    return refining.refine(CHAIN, features, PRIOR, wide, truth(x) + noise, frames, start, render, seed=seed)


def brute(x: NDArray[np.float64], noise: NDArray[np.float64]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Mean and standard deviation of size, depth and modulus, from ten million specimens of the prior."""
    seen, rng = truth(x) + noise, np.random.default_rng(1)
    near = np.array([0.6, 0.6, np.inf, 0.4, 0.4])
    low, high = np.maximum(RANGES[:, 0], x[:5] - near), np.minimum(RANGES[:, 1], x[:5] + near)
    total, mean, square = 0.0, np.zeros(3), np.zeros(3)
    for _ in range(10):
        many = np.column_stack([rng.uniform(low, high, (10**6, 5)), rng.standard_normal(10**6)])
        weight = np.exp(-0.5 * ((truth(many) - seen) ** 2).sum(axis=1) / NOISE**2)
        total += weight.sum()
        mean += weight @ many[:, :3]
        square += weight @ many[:, :3] ** 2
    mean /= total
    return mean, np.sqrt(square / total - mean**2)


@pytest.mark.parametrize("modulus", [60.0, 95.0])
def test_valley_is_the_posterior(modulus: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Mean and spread as brute force finds them, where the posterior is bent and cut at its ranges."""
    x = np.array([7.0, 6.0, modulus, 0.3, -0.2, 0.4])
    monkeypatch.setattr(refining, "_REMAINS", 0.0)
    found = refined(x, 1.0, seed=5)
    noise = NOISE * np.random.default_rng(5).standard_normal(K)
    mean, sd = brute(x, noise)
    drawn = found.samples[:, :3]
    assert np.all(np.abs(drawn.mean(axis=0) - mean) < 0.15 * sd)
    assert np.all(np.abs(drawn.std(axis=0) / sd - 1.0) < 0.12)


@pytest.mark.parametrize("modulus", [60.0, 85.0, 110.0])
def test_a_wrong_map_is_no_knowledge_of_the_modulus(modulus: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its error changes along the valley by ten times the noise: the posterior is that of a perfect map."""
    x = np.array([7.0, 6.0, modulus, 0.3, -0.2, 0.4])
    wrong = refined(x, 9.0, seed=5).samples[:, :3]
    monkeypatch.setitem(globals(), "light_map", truth)
    right = refined(x, 9.0, seed=5).samples[:, :3]
    print(modulus, wrong.mean(axis=0), right.mean(axis=0), wrong.std(axis=0) / right.std(axis=0))
    assert np.all(np.abs(wrong.mean(axis=0) - right.mean(axis=0)) < 0.2 * right.std(axis=0))
    assert np.all(np.abs(wrong.std(axis=0) / right.std(axis=0) - 1.0) < 0.15)


def test_the_error_of_the_map_goes() -> None:
    """Without noise the truth is found, though the map is off by many times the noise of so many frames."""
    x = np.array([9.0, 6.0, 80.0, 0.3, -0.2, 0.0])
    start = np.array([9.3, 5.8, 90.0, 0.0, 0.0, 0.0])
    features: Any = Features()
    wide = np.eye(K) * 0.15**2
    plain = fitting.fit(CHAIN, features, PRIOR, truth(x), 1e4, start, wide)
    found = refining.refine(CHAIN, features, PRIOR, wide, truth(x), 1e4, start, render)
    off, left = np.abs(plain.x - x)[:3], np.abs(found.fitted.x - x)[:3]
    assert np.all(left < 0.1 * off)
    assert found.explains


def test_intervals_cover_what_they_say() -> None:
    """Of 120 inclusions drawn from the prior, 90 % intervals hold the truth 90 % of the time."""
    rng, inside = np.random.default_rng(2), []
    for seed in range(120):
        x = np.array([*rng.uniform(RANGES[:, 0] + [3, 0, 0, 0, 0], RANGES[:, 1]), rng.standard_normal()])
        drawn = refined(x, 1.0, seed).samples[:, :3]
        low, high = np.percentile(drawn, [5.0, 95.0], axis=0)
        inside.append((low <= x[:3]) & (x[:3] <= high))
    share = np.mean(inside, axis=0)
    assert np.all(np.abs(share - 0.9) < 3.0 * np.sqrt(0.09 / 120)), share


def test_quick_pictures_tell_the_same_valley(monkeypatch: pytest.MonkeyPatch) -> None:
    """References apart, and quick pictures off by a hundred times the noise, the same for all: the posterior
    is that of whole ones; where references change, whole pictures are taken."""

    def pair(seen: NDArray[np.float64]) -> NDArray[np.float32]:
        """What is seen without an inclusion, which hangs on the gain alone, beside all of it."""
        plain = np.broadcast_to(seen[..., 6:7], seen.shape)
        return np.stack([seen, plain], axis=-1)[..., None, None].astype(np.float32)

    def expected(chain: Any, prior: Prior, many: Any, near: Any = None) -> NDArray[Any]:
        seen = pair(light_map(np.array(many)))
        return seen if near is None else seen + near.of(many)

    class Both(Features):
        def __call__(self, pictures: NDArray[Any]) -> NDArray[Any]:
            return np.asarray(pictures).reshape(-1, K, 2)[..., 0]

    for module in (fitting, refining):
        monkeypatch.setattr(module, "expected", expected)
    x, looks = np.array([7.0, 6.0, 85.0, 0.3, -0.2, 0.4]), []

    def unknowns(values: Mapping[str, float]) -> NDArray[np.float64]:
        return np.array([*(values[name] for name in PARAMETERS), values["gain"] / 0.02])

    def whole(values: Mapping[str, float]) -> NDArray[np.float32]:
        looks.append("whole")
        return pair(truth(unknowns(values)))

    def quick(values: Mapping[str, float]) -> NDArray[np.float32]:
        looks.append("quick")
        return pair(truth(unknowns(values)))[:, :1] + np.float32(100 * NOISE)

    features: Any = Both()
    told = truth(x) + NOISE * np.random.default_rng(5).standard_normal(K)
    start = x + np.array([0.4, -0.3, -5.0, 0.0, 0.0, 0.0])
    parts = (CHAIN, features, PRIOR, np.eye(K) * 0.15**2, told, 1.0, start)
    monkeypatch.setattr(refining, "_ALIKE", 1.0)
    monkeypatch.setattr(valley, "_UNSURE", np.inf)  # the same moduli in both
    one = refining.refine(*parts, whole, seed=5)
    looks.clear()
    other = refining.refine(*parts, whole, quick=quick, seed=5)
    assert looks.count("quick") > looks.count("whole") > 0
    np.testing.assert_allclose(other.samples, one.samples, rtol=1e-3, atol=1e-3)
    monkeypatch.setattr(refining, "_ALIKE", 0.0)
    looks.clear()
    refining.refine(*parts, whole, quick=quick, seed=5)
    assert looks.count("quick") == 0


def test_a_changed_brightness_is_no_inclusion(monkeypatch: pytest.MonkeyPatch) -> None:
    """Rendered light answers the gain by more than the map's: quick pictures, which have no references, leave
    the map's error as it was where the gain alone changes, for picture and reference alike. Where they would
    be worse than the noise, what is found is rendered whole again."""

    def pair(x: NDArray[np.float64], answer: float) -> NDArray[np.float32]:
        signal = np.array([0.01 * x[0] ** 3, 0.0])
        return np.asarray((1.0 + answer * x[5]) * (10.0 + signal), np.float32).reshape(1, 2, 1, 1)

    def expected(chain: Any, prior: Prior, many: Any) -> NDArray[Any]:
        return np.stack([pair(np.asarray(x), 0.02) for x in many])

    def unknowns(values: Mapping[str, float]) -> NDArray[np.float64]:
        return np.array([*(values[name] for name in PARAMETERS), values["gain"] / 0.02])

    def whole(values: Mapping[str, float]) -> NDArray[np.float32]:
        return pair(unknowns(values), 0.022)

    monkeypatch.setattr(refining, "expected", expected)
    at = np.array([8.0, 6.0, 80.0, 0.0, 0.0, 0.2])
    off = refining.Off(CHAIN, PRIOR, at, whole, lambda values: whole(values)[:, :1])
    brighter, larger = at + np.array([0, 0, 0, 0, 0, 0.3]), at + np.array([0.5, 0, 0, 0, 0, 0])
    assert np.allclose(off(brighter), off(at), atol=1e-6)
    true = pair(larger, 0.022) - pair(larger, 0.02)
    assert np.allclose(off(larger), true, atol=1e-6) and not np.allclose(true[:, 0], off(at)[:, 0], atol=1e-4)

    rough = refining.Off(CHAIN, PRIOR, at, whole, lambda values: 0.97 * whole(values)[:, :1])
    for sd, again in ((0.5, False), (0.05, True)):  # one standard deviation away, and ten
        spread = np.diag([sd, 1.0, 1.0, 1.0, 1.0, 1.0]) ** 2
        rough.look(fitting.Fitted(larger, spread, 1.0, pair(larger, 0.02)))
        assert np.allclose(rough(larger), true, atol=1e-6) == again


@pytest.mark.parametrize("modulus", [60.0, 95.0])
def test_a_good_map_needs_no_rendering(modulus: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Off by a tenth of the noise, and known to be: the posterior is that by rendering; off by more, it is
    rendered."""
    x = np.array([7.0, 6.0, modulus, 0.3, -0.2, 0.4])
    rough = light_map
    monkeypatch.setitem(globals(), "light_map", lambda x: truth(x) + 0.02 * (rough(x) - truth(x)))
    found = refined(x, 1.0, seed=5, error=0.1 * NOISE)
    assert found.renders == 0 and found.explains
    rendered = refined(x, 1.0, seed=5)
    assert rendered.renders > 0
    one, other = found.samples[:, :3], rendered.samples[:, :3]
    assert np.all(np.abs(one.mean(axis=0) - other.mean(axis=0)) < 0.15 * other.std(axis=0))
    assert np.all(np.abs(one.std(axis=0) / other.std(axis=0) - 1.0) < 0.1)


def test_a_start_beside_the_end_of_a_range_is_no_place_to_stay() -> None:
    """The first step would go over the end: all else goes on from there."""
    features: Any = Features()
    x = np.array([7.0, 4.0, 100.0, 0.1, 0.0, 0.0])
    start = np.array([6.5, 4.0 + 1e-7, 70.0, 0.4, 0.3, 0.0])
    deeper = light_map(x + np.array([0, 0.2, 0, 0, 0, 0])) - light_map(x)
    seen = light_map(x) - 0.2 * deeper  # of one that is not as deep as any
    found = fitting.fit(CHAIN, features, PRIOR, seen, 1.0, start)
    np.testing.assert_allclose(found.x[[0, 1, 3]], x[[0, 1, 3]], atol=0.1)
    assert found.chi_square < 0.1 * K


@pytest.mark.parametrize("along", [True, False])
def test_a_fit_goes_along_a_thin_bent_valley(along: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """From 115 kPa to 45 in five steps, by pictures with a hundredth of an exposure's noise; straight steps,
    or some share of them, leave the valley, and it takes more."""
    monkeypatch.setitem(globals(), "light_map", truth)
    monkeypatch.setattr(fitting, "_MOST", 5)
    if not along:
        monkeypatch.setattr(fitting, "bent", lambda x, step, moduli_kPa, tissue_kPa: x + step)
    x = np.array([8.0, 6.0, 45.0, 0.3, -0.2, 0.0])
    start, features = x.copy(), Features()
    start[[0, 2]] = 6.33, 115.0  # as much d³ contrast
    found = fitting.fit(CHAIN, features, PRIOR, light_map(x), 1e4, start)  # type: ignore[arg-type]
    assert (abs(found.x[2] - 45.0) < 0.1) == along, found.x


@pytest.mark.parametrize("depth", [11.9, 12.0 - 1e-5])
@pytest.mark.parametrize("modulus", [65.0, 75.0, 115.0])
def test_all_else_is_most_probable_with_the_modulus_held_and_the_depth_at_its_end(
    modulus: float, depth: float
) -> None:
    """The pictures ask for more depth than the range has: size, offsets and gain go where they are best then,
    as a bounded minimiser finds it, also from a hair beside the end."""
    observed = light_map(np.array([7.0, 12.15, 60.0, 1.0, -1.5, 0.5]))
    noise = linalg.cho_factor(np.eye(K) * 1e-6)
    rest, features = np.array([0, 1, 3, 4, 5]), Features()
    start = np.array([7.0, depth, modulus, 1.0, -1.5, 0.0])

    def cost(others: NDArray[np.float64]) -> float:
        x = np.insert(others, 2, modulus)
        off = (x - PRIOR.middle)[rest]
        away = observed - light_map(x)
        return float(away @ away / 1e-6 + off @ PRIOR.precision[np.ix_(rest, rest)] @ off)

    best = optimize.minimize(
        cost, start[rest], method="L-BFGS-B", bounds=[*RANGES[[0, 1, 3, 4]], (-4, 4)], options={"ftol": 1e-14}
    )
    near = valley.flat(start, np.zeros(Features.shape, np.float32))
    found = valley._held(CHAIN, features, PRIOR, observed, noise, start, rest, near)  # type: ignore[arg-type]
    assert found.x[1] == 12.0
    assert cost(found.x[rest]) < best.fun + 0.1


def test_what_cannot_be_rendered_is_not_explained() -> None:
    features: Any = Features()
    x = np.array([9.0, 6.0, 80.0, 0.3, -0.2, 0.0])
    strange = truth(x) * np.where(np.arange(K) % 2, 1.2, 0.8)
    found = refining.refine(
        CHAIN, features, PRIOR, np.eye(K) * 1e-4, strange, 1.0, np.array([9.0, 6, 80, 0, 0, 0]), render
    )
    assert not found.explains


def test_a_turned_prior_is_the_same_and_leaves_the_contact_alone() -> None:
    """Powers, gain and three depths that go together: three of six unknowns bear on the contact."""
    depths = [f"press.indentation_mm.{level}" for level in range(3)]
    names = ["leds.0.flux_W", "specimen.modulus_kPa", "camera.gain_e_per_dn", "specimen.thickness_mm"]
    names += [*depths, "leds.1.flux_W"]
    rng = np.random.default_rng(4)
    free = rng.standard_normal((4000, 6))
    deeper = free[:, 5:] * [1.0, 2.0, 2.9]
    table = np.concatenate([free[:, :4], deeper, free[:, 4:5]], axis=1) * 0.01 + 1.0
    drawn = [{**dict.fromkeys(PARAMETERS, 5.0), **dict(zip(names, row, strict=True))} for row in table]
    prior = fitting.prior_of(RANGES, drawn)
    expected = np.cov(table.T)
    assert np.allclose(prior.basis @ prior.basis.T, expected, atol=1e-9 * expected.max())
    bright = np.array([name.startswith(("leds.", "camera.")) for name in names])
    assert (prior.basis[~bright] != 0.0).any(axis=0).sum() == 3
    assert np.linalg.matrix_rank(prior.basis) == 6


@pytest.mark.parametrize(
    "nodes",
    [
        # of pictures of (9, 5.5, 80), whose spline rose again towards 120 kPa, and of a steep start
        [(52.8, -4.47), (68.0, -0.84), (83.1, 0.0), (120.0, -0.63)],
        [(70.4, -1983.0), (77.7, -549.0), (79.5, -136.0), (84.9, -51.6), (99.4, 0.0), (120.0, -0.36)],
    ],
)
def test_between_moduli_the_density_is_not_beyond_theirs(nodes):
    moduli, logs = np.array(nodes).T
    points = np.insert(np.tile([9.0, 5.5, 1.0, -0.5, 0.0], (len(moduli), 1)), 2, moduli, axis=1)
    found = valley.Valley(moduli, logs, points, np.tile(1e-4 * np.eye(4), (len(moduli), 1, 1)))
    drawn = found.draw(PRIOR, 40000, 0)[:, 2]
    density, edges = np.histogram(drawn, 40, (moduli[0], moduli[-1]), density=True)
    log = np.log(np.maximum(density, 1e-12))
    top = log.max()
    right = log[(edges[1:] > 100.0)]
    assert np.polyfit(np.arange(len(right)), right, 1)[0] < 0.0
    for low, high, left, right in zip(moduli[:-1], moduli[1:], logs[:-1], logs[1:], strict=True):
        inside = (edges[:-1] >= low) & (edges[1:] <= high) & (density > 0.0)
        assert (log[inside] - top < max(left, right) - logs.max() + 0.15).all()
