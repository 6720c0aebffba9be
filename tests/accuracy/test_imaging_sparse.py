"""Images of few samples in time against the plain sum over all visibilities, in the maximum norm, edges and all."""

from dataclasses import replace

import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import SkyCoord

import instrument
from instrument import Imager, Observation, PointSky, Scene
from instrument.image import dirty
from instrument.image.sparse import Span
from instrument.observe.directions import LIGHT

CENTRE = SkyCoord("08h13m36.0s +48d13m03s")
STATIONS = ["CS001HBA0", "CS002HBA0", "CS002HBA1", "CS003HBA1", "CS011HBA0", "CS021HBA0", "CS302HBA1", "RS106HBA"]

COUNT = 600  # of 20 s
SMALL = {"pixels": 32, "pixel": 8 * u.arcmin}  # 4.3 deg
INNER = np.pad(np.arange(900).reshape(30, 30) % 7 > 0, 1)
PLACES = np.flatnonzero(~INNER)  # the edges, and every seventh pixel


def visibilities(frequencies=(150,)):
    """Of random numbers, of 8 stations over 200 minutes."""
    observation = Observation(
        phase_centre=CENTRE, transit="2012-12-07", duration=COUNT * 20 * u.s, interval=20 * u.s,
        frequencies=frequencies * u.MHz, channel_width=0.2 * u.MHz,
    )  # fmt: skip
    array = instrument.load("telescopes", "lofar-hba", beam=None, stations=STATIONS)
    vis = Scene(instrument=array, sky=PointSky.at(CENTRE, [1.0]), observation=observation).plan().run()
    rng = np.random.default_rng(0)
    return vis.with_data(rng.normal(size=vis.data.shape) + 1j * rng.normal(size=vis.data.shape))


def plain_sum(vis, weight, f=0):
    """sum_k w_k Re(V_k exp(+2 pi i (u l + v m + w (n-1)))) / sum w at `PLACES`, (4, P); weights (T, B, 1 or 4)."""
    lmn = Imager(**SMALL).grid().lmn[PLACES]
    uvw = (vis.uvw_m * vis.freq_hz[f] / LIGHT).reshape(-1, 3)
    values = np.where(weight > 0, vis.stokes()[:, f] * weight, 0.0).reshape(-1, 4)
    return (np.exp(2j * np.pi * (lmn @ uvw.T)) @ values).real.T / weight.sum(axis=(0, 1))[:, None]


@pytest.fixture(scope="module")
def random():
    return visibilities()


@pytest.fixture
def spans(monkeypatch):
    """The numbers of samples and of visibilities of what is gridded by samples."""
    found = []
    gridded = Span.gridded
    monkeypatch.setattr(Span, "gridded", lambda span: found.append(gridded(span)) or found[-1])
    return found


def wrong(got, want, accuracy):
    """The largest error of a pixel, in parts of what is promised where the mean of |V| is 1."""
    return np.abs(got.data[0].reshape(4, -1)[:, PLACES] - want).max() / accuracy


def test_no_pixel_is_off_by_more_than_the_accuracy_asked_for(random, spans):
    """Relative to the rms of the image, which the mean of |V| exceeds 100 times here."""
    want = plain_sum(random, np.ones((COUNT, 28, 1)))
    for accuracy in (1e-3, 1e-4, 1e-6, 1e-8, 1e-10):
        got = Imager(**SMALL, accuracy=accuracy).image(random)
        assert wrong(got, want, accuracy) <= np.sqrt((want**2).mean())
        assert len(spans[-1][0]) < 0.5 * COUNT * 28


@pytest.mark.parametrize("corner", [(0, 0), (31, 16)])
def test_errors_that_add_up_stay_below_the_accuracy(random, spans, corner):
    """A source on the edge: every visibility has its error at the same phase."""
    grid = Imager(**SMALL).grid()
    lmn = grid.lmn[np.ravel_multi_index(corner, (32, 32))]
    fringe = np.exp(-2j * np.pi * (random.uvw_m @ lmn) * (random.freq_hz[0] / LIGHT))
    vis = random.with_data(fringe[:, None, :, None, None] * np.eye(2))
    want = plain_sum(vis, np.ones((COUNT, 28, 1)))
    assert want[0].max() == pytest.approx(1, abs=1e-9)
    for accuracy in (1e-3, 1e-5, 1e-9):
        assert wrong(Imager(**SMALL, accuracy=accuracy).image(vis), want, accuracy) <= 1
    assert len(spans) == 3


def test_weights_flags_and_uv_range_are_those_of_all_visibilities(random, spans):
    """Weights of correlations, a NaN without weight, a NaN beside known correlations, baselines that come and go."""
    rng = np.random.default_rng(1)
    weight = rng.uniform(0.1, 3, (COUNT, 1, 28, 2, 2))
    flag = rng.random((COUNT, 1, 28, 2, 2)) < 0.2
    data = np.array(random.data)
    data[flag] = np.nan
    vis = replace(random.with_data(data).flagged(flag), weight=weight)
    uv_range = (50, 900)
    length = np.hypot(*np.moveaxis(vis.uvw_m[..., :2], -1, 0)) * vis.freq_hz[0] / LIGHT
    inside = (length >= uv_range[0]) & (length <= uv_range[1])
    for one in (vis, replace(random, flag=flag[..., 0, 0], weight=weight[..., 0, 1])):
        imager = Imager(**SMALL, uv_range=uv_range, accuracy=1e-6)
        got = imager.image(one)
        each = one.stokes_weight[:, 0] * inside[..., None]
        want = plain_sum(one, each)
        assert wrong(got, want, 1e-6) <= 1
        assert got.psf.data[0, 16, 16] == pytest.approx(1, abs=1e-6)
    assert len(spans) == 2
    assert len(spans[0][0]) < 0.8 * inside.sum()


def blocks_of(vis, times, channels):
    """The blocks of a set, of so many times and channels."""
    for t in range(0, vis.data.shape[0], times):
        for f in range(0, vis.data.shape[1], channels):
            yield vis.block(slice(t, t + times), slice(f, f + channels))


@pytest.mark.parametrize("weighting", ["natural", "uniform"])
def test_blocks_gaps_and_memory_do_not_change_the_images(weighting, monkeypatch, spans):
    vis = visibilities((150, 151))
    kept = np.r_[0:123, 131:400, 405:COUNT]
    gone = np.ones((COUNT, 1, 1), bool)
    gone[kept] = False
    imager = Imager(**SMALL, accuracy=1e-7, weighting=weighting)
    whole = imager.image(vis.flagged(gone))
    monkeypatch.setattr(dirty, "HELD", 4000)  # a third of the samples
    monkeypatch.setattr(dirty, "ALL_HELD", 6000)
    del spans[:]
    parts = [vis.block(slice(first, last), slice(None)) for first, last in ((0, 123), (131, 400), (405, COUNT))]
    some = [block for part, channels in zip(parts, (1, 2, 2), strict=True) for block in blocks_of(part, 13, channels)]
    got = imager.image(some)
    assert len(spans) >= 4
    assert np.abs(got.data - whole.data).max() < 1e-7
    assert np.abs(got.psf.data - whole.psf.data).max() < 1e-7


def test_channels_that_come_one_after_the_other_are_gridded_once_each(monkeypatch, spans):
    """They shared what may be held before, and each was gridded in pieces; those that come in turns still are."""
    vis = visibilities((149, 150, 151, 152))
    imager = Imager(**SMALL, accuracy=1e-7)
    whole = imager.image(vis)
    count = max(len(columns[0]) for _, columns, _ in spans)
    monkeypatch.setattr(dirty, "HELD", 2 * count)
    monkeypatch.setattr(dirty, "ALL_HELD", 2 * count)
    for times, gridded in ((COUNT, range(4, 5)), (COUNT // 5, range(5, 41))):
        del spans[:]
        got = imager.image([*blocks_of(vis, times, 1)])
        assert len(spans) in gridded
        assert max(len(columns[0]) for _, columns, _ in spans) <= 2 * count
        assert np.abs(got.data - whole.data).max() < 1e-7
        assert np.abs(got.psf.data - whole.psf.data).max() < 1e-7


def test_times_without_order_and_given_uvw_are_gridded_as_they_are(random, spans):
    imager = Imager(**SMALL, accuracy=1e-7)
    given = replace(random, given_uvw_m=random.uvw_m)
    rng = np.random.default_rng(3)
    jumbled = np.sort(rng.choice(COUNT, 60, replace=False))
    late = replace(random.block(slice(0, 60), slice(None)), at=random.at.some(jumbled))
    few = random.block(slice(0, 40), slice(None))
    for vis in (given, few):
        got = imager.image(vis)
        assert not spans
        want = plain_sum(vis, np.ones((len(vis.data), 28, 1)))
        assert wrong(got, want, 1e-7) <= 1
    slots = random.at.slots_s + rng.uniform(-3, 3, COUNT)
    moved = replace(random, at=replace(random.at, slots_s=slots))
    imager.image(moved)
    assert not spans
    want = plain_sum(late, np.ones((60, 28, 1)))
    assert wrong(imager.image(late), want, 1e-7) <= 1  # on the same clock, with gaps
