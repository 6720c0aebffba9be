"""Cases of imagers: one visibility, the edge of the sky, weights of nothing and of everything, blanks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from instrument.image.base import AnyImager
from instrument.image.weights import Density
from instrument.observe.directions import LIGHT
from instrument.stress.bench import field, observed, small_array
from instrument.stress.case import Answer, Unfit, both, case, claim, held, not_there
from instrument.units import Float
from instrument.visibilities import Visibilities


def _few(times: int = 2, stations: int = 8) -> Visibilities:
    return observed(small_array(stations, spread=60.0), field(), times)


def _sized(imager: AnyImager, pixel_rad: float, **more: object) -> AnyImager:
    from astropy import units as u

    if "weighting" in type(imager).model_fields:
        more = {"weighting": "natural", **more}
    return imager.with_fields(pixels=64, pixel=pixel_rad * u.rad, uv_range=None, **more)


def _lmn(pixel_rad: float) -> tuple[Float, Float, Float]:
    """l, m and n - 1 of 64 x 64 pixels; NaN beyond the sky."""
    side: Float = pixel_rad * (np.arange(64.0) - 32)
    l, m = np.broadcast_arrays(-side[None, :], side[:, None])
    with np.errstate(invalid="ignore"):
        return l, m, np.asarray(np.sqrt(1 - l**2 - m**2) - 1)


def _sum(data: Visibilities, pixel_rad: float) -> Float:
    """The image of Stokes I by the plain sum, natural weights (64, 64)."""
    axes = np.stack(_lmn(pixel_rad), axis=-1)
    uvw = data.uvw_m.reshape(-1, 3) * data.freq_hz[0] / LIGHT
    weight = np.broadcast_to(data.whole_weight, data.data.shape[:3])[:, 0].ravel()
    stokes = data.stokes()[:, 0, :, 0].ravel()
    out = np.zeros((64, 64))
    for k in np.flatnonzero(weight):
        out += weight[k] * (stokes[k] * np.exp(2j * np.pi * (axes @ uvw[k]))).real
    return out / weight.sum()


def _asked(imager: AnyImager) -> float:
    """What the imager says of its accuracy, or 1e-6."""
    return float(getattr(imager, "accuracy", 1e-6))


@case("40", "imagers", "one visibility", "its cosine at all pixels, corners included, within the accuracy asked for")
def one_visibility(imager: AnyImager) -> Answer:
    """All others are flagged; pixels of 0.02 rad, corners at l^2 + m^2 = 0.82."""
    data = _few()
    flag = np.ones(data.data.shape[:3], bool)
    flag[0, 0, 11] = False
    one = data.flagged(flag)
    found = _sized(imager, 0.02).image(one).data[0, 0]
    due = _sum(one, 0.02)
    return held(found, due, _asked(imager), scale=float(np.sqrt((due**2).mean())))


@case("41", "imagers", "pixels beyond l^2 + m^2 = 1", "NaN or 0, or the image is refused", refusal=True)
def beyond(imager: AnyImager) -> Answer:
    """64 pixels of 5 deg are 5.6 in l."""
    pixel = float(np.deg2rad(5))
    found = _sized(imager, pixel).image(_few()).data[0]
    out = found[:, ~np.isfinite(_lmn(pixel)[2])]
    return claim(bool(np.all(~np.isfinite(out) | (out == 0))), "numbers where there is no sky")


@case("42", "imagers", "the largest error, at the edge", "within the accuracy asked for, 1e-4 to 1e-10, of the rms")
def edge(imager: AnyImager) -> Answer:
    """Against the plain sum; digits are those of the worst of four, relative to what was asked."""
    if not hasattr(imager, "accuracy"):
        raise Unfit("it takes no accuracy")
    if imager.restores:
        raise Unfit("its images are no sums of visibilities")
    data = _few()
    due = _sum(data, 0.02)
    rms = float(np.sqrt((due**2).mean()))
    answers = []
    for asked in (1e-4, 1e-6, 1e-8, 1e-10):
        found = _sized(imager, 0.02, accuracy=asked).image(data).data[0, 0]
        answers.append(Answer(float(np.abs(found - due).max()) / rms, asked))
    return both(*answers)


@case("43", "imagers", "Briggs +-infinity, and one hit a cell", "natural and uniform weights, to 1e-12", refusal=True)
def briggs(imager: AnyImager) -> Answer:
    """The factors on the weights, at robust 20 and -20, where they are at their limits; one hit a cell: both alike."""
    if "weighting" not in type(imager).model_fields:
        raise Unfit("it takes no weighting")
    rng = np.random.default_rng(1)
    uv, weight = rng.uniform(-20, 20, (300, 2)), rng.uniform(0.5, 2, (300, 1))
    density = Density(64, 0.02)
    density.add(uv, weight)
    natural = density.factor(uv, "briggs", 20.0)
    tight = density.factor(uv, "briggs", -20.0)
    uniform = density.factor(uv, "uniform", 0.0)
    alone = Density(64, 0.02)
    cells = np.array([[3.2, 7.1], [9.4, -2.0], [-8.8, 5.5], [1.1, 1.3]])
    alone.add(cells, np.ones((4, 1)))
    one = alone.factor(cells, "uniform", 0.0)
    answers = [held(natural, np.ones(1), 1e-12), held(tight / tight[0], uniform / uniform[0], 1e-12)]
    return both(*answers, held(one, np.full((4, 1), one[0, 0]), 1e-12))


@case(
    "44",
    "imagers",
    "data doubled",
    "the same image within its accuracy; of other data the mean: half the variance; weights twice",
)
def doubled(imager: AnyImager) -> Answer:
    """Every integration twice, as one set of 4 and as weights of 2."""
    data = _few()
    due = _sized(imager, 0.01).image(data)
    heavy = data.weighted(np.full((1, 1, 1), 2.0))
    at = data.at
    earth = type(at.earth)(np.tile(at.earth.matrices, (2, 1, 1)), np.tile(at.earth.velocity, (2, 1)))
    twice = replace(at, slots_s=np.concatenate([at.slots_s, at.slots_s + 1e-3]), earth=earth)
    both_times = replace(data, data=np.concatenate([data.data] * 2), at=twice, interval_s=data.integration_s)
    # of other data as well: the image is the mean of both, so that independent noise has half the variance
    other = data.with_data(np.random.default_rng(2).normal(size=(*data.data.shape, 2)).view(complex)[..., 0])
    mixed = replace(both_times, data=np.concatenate([data.data, other.data]))
    mean = (due.data + _sized(imager, 0.01).image(other).data) / 2
    # a gridder may choose another kernel for twice as many visibilities
    ways = ((heavy, 1e-10), (both_times, 2 * _asked(imager)))
    answers = [held(_sized(imager, 0.01).image(v).data, due.data, limit) for v, limit in ways]
    answers.append(held(_sized(imager, 0.01).image(mixed).data, mean, 2 * _asked(imager)))
    total = [float(np.broadcast_to(v.whole_weight, v.data.shape[:3]).sum()) for v in (data, heavy, both_times)]
    return both(*answers, held(np.array(total[1:]), 2 * total[0], 1e-15))


@case(
    "47", "imagers", "one Stokes parameter, or one channel, of weight 0", "that one NaN, the others unchanged to 1e-6"
)
def nothing_of_one(imager: AnyImager) -> Answer:
    """pq and qp flagged: U and V. Channel 1 of 2 flagged: all of it."""
    data = observed(small_array(8, spread=60.0), field(), 2, (150.0, 152.0))
    sized = _sized(imager, 0.01)
    due = sized.image(data).data
    crossed = np.zeros(data.data.shape, bool)
    crossed[..., 0, 1] = crossed[..., 1, 0] = True
    second = np.zeros(data.data.shape[:3], bool)
    second[:, 1] = True
    first = sized.image(data.flagged(crossed)).data
    whole = sized.image(data.flagged(second)).data
    blank = np.isnan(first[:, 2:]).all() and np.isnan(whole[1]).all()
    kept = both(held(first[:, :2], due[:, :2], 1e-6), held(whole[0], due[0], 1e-6))
    return both(kept, claim(blank, "numbers of a Stokes parameter or channel that has no weight"))


@case("K8", "cubes", "densities of the uv plane by hand", "weights of Briggs (1995) at robust -1, 0, 1, to 1e-13")
def density(_: None) -> Answer:
    """20 x 20 cells of 4 wavelengths, both halves; visibilities of 3 weights; one beyond the grid has none."""
    rng = np.random.default_rng(2)
    uv, weight = rng.uniform(-35, 35, (200, 2)), rng.uniform(0.5, 2, (200, 1))
    uv[0] = 60, 3
    made = Density(20, 1 / 80)
    made.add(uv[:120], weight[:120])
    made.add(uv[120:], weight[120:])
    cell = np.round(uv / 4).astype(int)
    inside = np.all((cell >= -10) & (cell < 10), axis=1)
    back = np.all((-cell >= -10) & (-cell < 10), axis=1)
    total: dict[tuple[int, int], float] = {}
    for (a, b), w, one, two in zip(cell.tolist(), weight[:, 0], inside, back, strict=True):
        if one:
            total[a, b] = total.get((a, b), 0.0) + w
        if two:
            total[-a, -b] = total.get((-a, -b), 0.0) + w
    mine = np.array([total.get((a, b), 0.0) if ok else 0.0 for (a, b), ok in zip(cell.tolist(), inside, strict=True)])
    mean = sum(t**2 for t in total.values()) / (2 * weight.sum())
    answers = [held(made.factor(uv, "uniform", 0.0)[:, 0], np.where(inside, 1 / np.where(inside, mine, 1), 0), 1e-13)]
    for robust in (-1.0, 0.0, 1.0):
        due = np.where(inside, 1 / (1 + (5 * 10**-robust) ** 2 / mean * mine), 0)
        answers.append(held(made.factor(uv, "briggs", robust)[:, 0], due, 1e-13))
    return both(*answers)


MISSING = (
    not_there("49", "imagers", "a cut at a baseline's own length in float32", "the count of float64", "float64 only"),
)
