"""The table of expected signs in docs/conventions.md: each of its lines names one test of this file."""

import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import AltAz, EarthLocation, SkyCoord, get_sun
from astropy.cosmology import Planck15
from instrument_plugins.elements.dipole import CrossedDipole

import instrument
from instrument import (
    Analyzer,
    Chain,
    Composed,
    ElementBeam,
    FeedTerm,
    GainTerm,
    Imager,
    InputError,
    Layout,
    Level,
    Observation,
    Parallactic,
    PointSky,
    Psf,
    Sampling,
    Scene,
    StationBeam,
    StokesCube,
    Towards,
    mat2,
    mueller,
)
from instrument.jones.station import ArrayFactor
from instrument.observe.directions import LIGHT

LONGITUDE, LATITUDE = np.deg2rad(6.87), np.deg2rad(52.9)
SITE = (LONGITUDE * u.rad, LATITUDE * u.rad, 0 * u.m)
CENTRE = SkyCoord("08h13m36.0s +52d54m00s")  # culminates at the zenith, to 0.1 deg
FIELD = SkyCoord("08h13m36.0s +48d13m03s")  # 3C196
NIGHT = Observation(
    phase_centre=CENTRE, transit="2012-12-07", duration=10 * u.s, interval=10 * u.s, frequencies=[150] * u.MHz
)
LAMBDA = LIGHT / 150e6


def pair(east=0.0, north=0.0, up=0.0):
    """Two stations, the first of them displaced from the second, m."""
    return Layout.from_enu(["first", "second"], [[east, north, up], [0, 0, 0]] * u.m, *SITE)


def at(sky_offset, stokes=(1.0, 0.0, 0.0, 0.0), **fields):
    """A source at an offset (east, north) in deg from the phase centre, along great circles."""
    east, north = sky_offset
    where = CENTRE.directional_offset_by(np.arctan2(east, north) * u.rad, np.hypot(east, north) * u.deg)
    return PointSky.at(where, [stokes], **fields)


def observe(sky, layout, *terms, night=NIGHT):
    """Visibilities of one baseline."""
    return Scene(instrument=Composed(stations=layout, terms=Chain(*terms)), sky=sky, observation=night).plan().run()


def sampling(sky, layout, night=NIGHT):
    return Sampling.build(layout, night.times(layout), night.freq_hz, *sky.directions(), night.phase_centre)


def jones(seed, shape=()):
    rng = np.random.default_rng(seed)
    return rng.normal(size=(*shape, 2, 2)) + 1j * rng.normal(size=(*shape, 2, 2))


# coordinates


def test_l_grows_east_and_m_grows_north():
    east, north = (sampling(at(where), pair(east=100)).lmn[0] for where in ((1, 0), (0, 1)))
    assert east[0] == pytest.approx(np.sin(np.deg2rad(1))) and abs(east[1]) < 1e-9
    assert north[1] == pytest.approx(np.sin(np.deg2rad(1))) and abs(north[0]) < 1e-9
    assert east[2] == pytest.approx(np.cos(np.deg2rad(1)) - 1)  # the third is n - 1, negative


@pytest.mark.parametrize(("axis", "side"), list(enumerate(("east", "north", "up"))))
def test_uvw_are_those_of_the_first_station_minus_the_second(axis, side):
    found = observe(at((0, 0)), pair(**{side: 100.0})).uvw_m[0, 0]
    assert found[axis] == pytest.approx(100, rel=1e-4)
    assert np.abs(np.delete(found, axis)).max() < 0.5  # the zenith is 0.1 deg away from the phase centre


def test_baselines_have_the_station_of_lower_number_first():
    vis = observe(at((0, 0)), pair(east=100))
    assert list(zip(vis.antenna1, vis.antenna2, strict=True)) == [(0, 1)]


def test_a_source_in_the_east_has_negative_phase_when_the_first_station_is_the_eastern_one():
    vis = observe(at((1, 0)), pair(east=10.0))  # u l = 10 / 2 * 0.0175 = 0.087 turns
    assert np.angle(vis.data[0, 0, 0, 0, 0]) == pytest.approx(-2 * np.pi * 10 / LAMBDA * np.sin(np.deg2rad(1)), 1e-3)


def test_a_source_in_the_north_has_negative_phase_when_the_first_station_is_the_northern_one():
    vis = observe(at((0, 1)), pair(north=10.0))
    assert np.angle(vis.data[0, 0, 0, 0, 0]) == pytest.approx(-2 * np.pi * 10 / LAMBDA * np.sin(np.deg2rad(1)), 1e-2)


def test_a_source_at_the_phase_centre_has_no_phase():
    vis = observe(at((0, 0)), pair(10000, 20000, 30))
    np.testing.assert_allclose(vis.data[0, 0, 0], np.eye(2), atol=1e-12)


def test_times_are_the_centres_of_integrations():
    night = NIGHT.with_fields(transit=None, start="2012-12-07T00:00:00")
    assert night.times(pair(east=1))[0].isot == "2012-12-07T00:00:05.000"


# polarization of the sky


@pytest.mark.parametrize(
    ("stokes", "wanted"),
    [
        ((1, 0, 0, 0), [[1, 0], [0, 1]]),
        ((0, 1, 0, 0), [[1, 0], [0, -1]]),
        ((0, 0, 1, 0), [[0, 1], [1, 0]]),
        ((0, 0, 0, 1), [[0, 1j], [-1j, 0]]),
    ],
    ids="IQUV",
)
def test_1_jy_of_each_stokes_parameter(stokes, wanted):
    vis = observe(at((0, 0), stokes), pair(east=100))
    np.testing.assert_allclose(vis.data[0, 0, 0], wanted, atol=1e-12)
    np.testing.assert_allclose(vis.stokes()[0, 0, 0], stokes, atol=1e-12)


def test_position_angle_counts_from_north_through_east():
    chi = np.deg2rad(30)
    field = np.array([np.cos(chi), np.sin(chi)])  # along north, along east
    found = mueller.stokes(np.outer(field, field).astype(complex))
    assert 0.5 * np.angle(found[1].real + 1j * found[2].real) == pytest.approx(chi)


def test_positive_rotation_measure_turns_the_position_angle_forward_towards_longer_waves():
    source = at((0, 0), (1, 1, 0, 0), frequency=150 * u.MHz, rotation_measure=[0.5])
    _, q, stokes_u, _ = source.stokes(np.array([149e6]))[0, 0]
    turn = 0.5 * ((LIGHT / 149e6) ** 2 - LAMBDA**2)
    assert turn > 0
    assert 0.5 * np.arctan2(stokes_u, q) == pytest.approx(turn)


def test_a_gaussian_loses_most_on_the_baseline_along_its_major_axis():
    shape = {"major_rad": [1e-3], "minor_rad": [1e-4]}
    for angle, along, across in ((0, (0, 1), (1, 0)), (90, (1, 0), (0, 1)), (45, (1, 1), (1, -1))):
        sky = at((0, 0), angle_rad=[np.deg2rad(angle)], **shape)
        on, off = (abs(observe(sky, pair(*(1500 * np.array(b)))).data[0, 0, 0, 0, 0]) for b in (along, across))
        assert on < 0.5 < 0.95 < off


# Jones terms


def test_receptor_p_of_the_first_station_is_the_first_row_and_of_the_second_the_first_column():
    for station, doubled in ((0, [[2, 1], [0.5, 1]]), (1, [[2, 0.5], [1, 1]])):
        values = np.ones((1, 1, 2, 2), complex)
        values[0, 0, station, 0] = 2
        v = observe(at((0, 0), (1, 0, 0.5, 0)), pair(east=100), GainTerm(values=values)).data[0, 0, 0]
        np.testing.assert_allclose(v, doubled, atol=1e-12)


def test_feed_errors_stand_with_a_minus_in_the_second_row():
    term = FeedTerm(values=np.array([0.1, 0.2], complex).reshape(1, 1, 1, 2))
    np.testing.assert_allclose(term.jones(sampling(at((0, 0)), pair(east=1)))[0, 0, 0, 0], [[1, 0.1], [-0.2, 1]])


def test_a_dipole_along_north_answers_to_the_first_column():
    """X towards north and Y, 90 deg further, towards west, height of a quarter wave, at the zenith."""
    beam = Chain(CrossedDipole(height=LAMBDA / 4 * u.m, x_azimuth=90 * u.deg), Parallactic())
    np.testing.assert_allclose(beam.jones(sampling(at((0, 0)), pair(east=1)))[0, 0, 0, 0], np.diag([1, -1]), atol=2e-3)


def test_west_of_the_meridian_the_zenith_stands_at_a_positive_position_angle():
    layout = pair(east=1)
    sky = at((0, 0))
    late = NIGHT.with_fields(transit=None, start=NIGHT.times(layout)[0] + 3 * u.hour)
    turn = Parallactic().jones(sampling(sky, layout, late))[0, 0, 0, 0].real
    hour_angle = np.deg2rad(45 * 1.0027379)
    dec = CENTRE.dec.rad
    q = np.arctan2(np.sin(hour_angle), np.tan(LATITUDE) * np.cos(dec) - np.sin(dec) * np.cos(hour_angle))
    assert q > 0
    # e_theta points away from the zenith, e_phi from east to north; precession turns both by some 0.1 deg
    np.testing.assert_allclose(turn, [[-np.cos(q), -np.sin(q)], [-np.sin(q), np.cos(q)]], atol=5e-3)
    assert np.linalg.det(turn) == pytest.approx(-1)


def test_mueller_matrices_take_the_conjugate_of_the_second_jones():
    a, b, stokes = jones(1), jones(2), np.array([1.0, 0.3, -0.2, 0.1])
    seen = mueller.stokes(mat2.sandwich(a, mueller.brightness(stokes), b))
    np.testing.assert_allclose(mueller.mueller(a, b) @ stokes, seen, atol=1e-12)
    # with J_b^H read literally, the circular leakage of one and the same Jones matrix would not even be real
    same, literal = mueller.mueller(a, a), mueller.mueller(a, np.conj(mat2.herm(a)))
    assert np.abs(same.imag).max() < 1e-12 < 0.1 < np.abs(literal.imag).max()


def test_first_order_errors_take_q_to_v_with_plus_i_half_delta_qv():
    """Only e_p, of rms 1e-4: what the first order leaves out is 1e-8."""
    e = 1e-4 * np.array([0.6 + 0.8j, -0.3 + 0.2j])
    a, b = (np.array([[1, x], [0, 1]]) for x in e)
    delta = mueller.di_errors(a, b)
    assert delta.qv == pytest.approx(e[0] - np.conj(e[1]))
    exact = mueller.mueller(a, b)
    assert exact[3, 1] == pytest.approx(+0.5j * delta.qv, abs=1e-8)
    assert exact[1, 3] == pytest.approx(-0.5j * delta.qv, abs=1e-8)


def test_first_order_errors_are_wrong_by_their_square():
    rms = 10.0 ** np.arange(-5, 0)
    wrong = []
    for r in rms:
        a, b = np.eye(2) + r * jones(3), np.eye(2) + r * jones(4)
        wrong.append(np.abs(mueller.mueller(a, b) - mueller.di_errors(a, b).first_order_mueller()).max())
    assert np.polyfit(np.log(rms), np.log(wrong), 1)[0] == pytest.approx(2, abs=0.05)


@pytest.fixture(scope="module")
def lofar():
    return instrument.load("telescopes", "lofar-hba", stations=["CS001HBA0", "CS001HBA1"])


def test_differential_beams_have_the_inverse_on_the_left(lofar):
    target = FIELD.directional_offset_by(45 * u.deg, 3 * u.deg)
    raw, at_centre = (lofar.beam(d, "2012-12-07T22:00:00", 150 * u.MHz, pointing=FIELD) for d in (target, FIELD))
    found = lofar.beam(target, "2012-12-07T22:00:00", 150 * u.MHz, pointing=FIELD, state="differential")
    np.testing.assert_allclose(found, mat2.inverse(at_centre) @ raw, atol=1e-12)
    assert np.abs(found - raw @ mat2.inverse(at_centre)).max() > 1e-3


def test_corrected_data_are_what_is_seen_through_the_differential_beam(lofar):
    """J_0^-1 V J_0^-H: nothing is left of the beam at the centre, and it is written down."""
    night = NIGHT.with_fields(phase_centre=FIELD)
    sky = PointSky.at(night.phase_centre.skycoord, [[1.0, 0.2, -0.1, 0.05]])
    vis = Scene(instrument=lofar, sky=sky, observation=night).plan().run()
    found = vis.corrected(Towards(chain=lofar.chain()))
    np.testing.assert_allclose(found.stokes()[0, 0, 0], sky.stokes_jy[0], atol=1e-12)
    assert (vis.beam_state.removed, found.beam_state.removed) == ("nothing", "centre")
    with pytest.raises(InputError, match="cannot mix"):
        found - vis


def test_array_factors_are_1_at_the_pointing_and_have_the_phase_of_the_fringe():
    offsets = pair(east=1.0).positions_m[:1] - pair(east=1.0).positions_m[1:]  # 1 m to the east
    one, other = (ArrayFactor(levels=(Level(offsets_m=offsets[None]),), phase=p) for p in ("fringe", "everybeam"))
    centre, east = (one.scalar(sampling(at(where), pair(east=100)))[0, 0, 0, 0] for where in ((0, 0), (1, 0)))
    assert centre == pytest.approx(1)
    assert np.angle(east) == pytest.approx(-2 * np.pi / LAMBDA * np.sin(np.deg2rad(1)), 1e-3)
    seen = observe(at((1, 0)), pair(east=1.0)).data[0, 0, 0, 0, 0]
    assert np.angle(east) == pytest.approx(np.angle(seen), 2e-4)  # 1e-4: differential aberration
    assert other.scalar(sampling(at((1, 0)), pair(east=100)))[0, 0, 0, 0] == east.conj()


class Turned(ElementBeam):
    """exp(+i chi) for both receptors."""

    chi: float = 0.3

    def jones(self, at):
        return np.exp(1j * self.chi) * (at.zenith_angle < np.pi / 2)[:, None, ..., None, None] * mat2.IDENTITY


def test_elements_are_given_for_exp_plus_i_omega_t_and_multiplied_as_the_conjugate():
    where = sampling(at((1, 0)), pair(east=100))
    station, theirs = (StationBeam(element=Turned(), levels=(), phase=p) for p in ("fringe", "everybeam"))
    for term, sign in ((Turned(), -1), (station, -1), (theirs, 1)):
        found = [Chain(term).jones(where), Chain(term).factors(where).shared]
        np.testing.assert_allclose([np.angle(x[0, 0, 0, 0, 0, 0]) for x in found], sign * 0.3, rtol=1e-12)
    assert Chain(*Chain(Turned()).parts).jones(where)[0, 0, 0, 0, 0, 0] == pytest.approx(np.exp(-0.3j))  # once only


def test_a_wave_that_is_right_handed_to_the_iau_has_negative_v():
    """Fields exp(-i omega t), as the fringe has them, correlated: Ex = cos(omega t), Ey = sin(omega t)."""
    turns = np.arange(64) / 64  # of the wave, at the second antenna
    early = 10.0 * np.sin(np.deg2rad(1)) / LAMBDA  # the first is 10 m nearer the source, 1 deg away
    positive = np.array([[[1.0], [1j]]])  # of exp(-i omega t): Re(i exp(-i x)) = sin x
    north, east = np.moveaxis((positive * np.exp(-2j * np.pi * turns)).real, 1, 0)
    angle = np.unwrap(2 * np.arctan2(east[0], north[0])) / 2
    assert np.all(np.diff(angle) > 0)
    first, second = (positive[0] * np.exp(-2j * np.pi * (turns + e)) for e in (early, 0.0))
    seen = np.einsum("pt,qt->pq", first, second.conj()) / len(turns)
    vis = observe(at((1, 0), (1.0, 0.0, 0.0, -1.0)), pair(east=10.0))
    np.testing.assert_allclose(seen, vis.data[0, 0, 0], rtol=0, atol=3e-3)


# images and noise


def test_in_images_east_is_left_and_north_is_up():
    night = NIGHT.with_fields(duration=6 * u.hour, interval=20 * u.min)
    layout = Layout.from_enu(list("abcd"), [[0, 0, 0], [400, 90, 0], [-150, 310, 0], [80, -260, 0]] * u.m, *SITE)
    vis = observe(at((2, 1), (1.0, 0.5, -0.25, 0.125)), layout, night=night)
    cube = Imager(pixels=64, pixel=6 * u.arcmin).image(vis)
    y, x = np.unravel_index(cube.data[0, 0].argmax(), (64, 64))
    assert (x, y) == (32 - 20, 32 + 10)
    np.testing.assert_allclose(cube.data[0, :, y, x], (1.0, 0.5, -0.25, 0.125), rtol=2e-3)
    where = cube.wcs.celestial.pixel_to_world(x, y)
    assert where.separation(at((2, 1)).middle.skycoord) < 0.5 * u.arcmin


def test_noise_is_that_of_the_radiometer_in_each_part_of_each_correlation():
    night = NIGHT.with_fields(duration=2000 * 10 * u.s, channel_width=0.19 * u.MHz)
    vis = observe(at((0, 0), (0, 0, 0, 1e-9)), pair(east=100), night=night)
    noise = vis.with_noise(sefd=2820 * u.Jy, seed=1).data - vis.data
    sigma = 2820 / np.sqrt(2 * 0.19e6 * 10)
    assert sigma == pytest.approx(1.45, abs=0.005)
    # 8000 numbers: their rms is known to 0.8 %
    assert noise.real.std() == pytest.approx(sigma, rel=0.03) and noise.imag.std() == pytest.approx(sigma, rel=0.03)


def test_random_numbers_depend_on_seed_and_time_only():
    night = NIGHT.with_fields(duration=60 * u.s, channel_width=0.2 * u.MHz)
    layout, sky = pair(east=100), at((0, 0))
    drawn = [GainTerm(rms=0.1, seed=s).jones(sampling(sky, layout, night)) for s in (1, 1, 2)]
    np.testing.assert_array_equal(drawn[0], drawn[1])
    assert np.abs(drawn[0] - drawn[2]).max() > 0.01
    late = sampling(sky, layout, night).block(slice(4, 6), slice(None))
    np.testing.assert_array_equal(GainTerm(rms=0.1, seed=1).jones(late), drawn[0][4:6])


# directions


def test_directions_equal_astropy_to_0_003_arcsec_in_the_field_and_0_03_anywhere(lofar):
    layout = lofar.layout()
    angle = np.linspace(0, 2 * np.pi, 8, endpoint=False) * u.rad
    rng = np.random.default_rng(1)
    field = FIELD.directional_offset_by(angle, 10 * u.deg)
    sky = SkyCoord(rng.uniform(0, 360, 50), np.rad2deg(np.arcsin(rng.uniform(-1, 1, 50))), unit="deg")
    night = NIGHT.with_fields(phase_centre=FIELD)
    times = night.times(layout)
    # the bending of light by the Sun is left out, 0.0041 arcsec cot(a / 2): 0.023 at 20 deg from it
    sun = get_sun(times[0])
    sky = sky[SkyCoord(sun.ra, sun.dec).separation(sky) > 20 * u.deg]
    site = EarthLocation.from_geocentric(*layout.centre_m, unit="m")
    for directions, limit in ((field, 0.003), (sky, 0.03)):
        ours = Sampling.build(layout, times, [150e6], directions.ra.rad, directions.dec.rad, night.phase_centre)
        seen = directions.transform_to(AltAz(obstime=times[0], location=site))
        alt, az = seen.alt.rad, seen.az.rad
        enu = np.stack([np.cos(alt) * np.sin(az), np.cos(alt) * np.cos(az), np.sin(alt)], axis=-1)
        lon, lat = site.lon.rad, site.lat.rad
        axes = np.array(
            [
                [-np.sin(lon), np.cos(lon), 0],
                [-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)],
                [np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)],
            ]
        )
        apart = np.linalg.norm(ours.itrf[0] - enu @ axes, axis=-1)
        assert np.rad2deg(apart.max()) * 3600 < limit


# cubes


def cube_of(field=None, q=None, p=None, count=161, pixels=(40, 40), unit="K", **fields):
    """161 channels of 0.2 MHz about 150 MHz, pixels of 2 arcmin, with some Stokes parameters (F, Ny, Nx)."""
    data = np.zeros((count, 4, *pixels))
    for k, plane in enumerate((field, q, p)):
        if plane is not None:
            data[:, k] = plane
    freq = 150e6 + 0.2e6 * (np.arange(count) - (count - 1) / 2)
    return StokesCube(data, freq * u.Hz, 2 * u.arcmin, unit, **fields)


def test_a_screen_at_plus_7_rad_per_m2_peaks_at_plus_7():
    lambda2 = (LIGHT / cube_of().freq_hz) ** 2
    turned = np.exp(2j * 7 * lambda2)[:, None, None]
    depths = np.linspace(-10, 50, 241)
    found = Analyzer(cube_of(q=turned.real, p=turned.imag, pixels=(1, 1))).rm_synthesis(depths)
    assert depths[np.argmax(np.abs(found.data[:, 0, 0]))] == pytest.approx(7)


def test_u_alone_is_an_angle_of_45_deg():
    found = Analyzer(cube_of(p=1.0, pixels=(1, 1))).rm_synthesis([0.0])
    assert found.data[0, 0, 0] == pytest.approx(1j, abs=1e-12)
    assert np.rad2deg(np.angle(found.data[0, 0, 0]) / 2) == pytest.approx(45)


def test_100_wavelengths_and_a_microsecond_at_150_mhz_in_k():
    across = 2 * np.deg2rad(1 / 60) * 40
    delay, wave = 31, 2  # cells; a little off 1 us and 100 wavelengths, in proportion
    field = np.cos(2 * np.pi * delay * np.arange(161) / 161)[:, None, None] * np.cos(
        2 * np.pi * wave * np.arange(40) / 40
    )
    found = Analyzer(cube_of(field=field)).cylindrical(taper=None, bins=200, log=False)
    i, j = np.unravel_index(np.nanargmax(found.power), found.power.shape)
    assert found.k_perp[i] / (wave / across) * 100 == pytest.approx(0.0677, rel=2e-3)
    assert found.k_par[j] / (delay / (161 * 0.2e6)) * 1e-6 == pytest.approx(0.365, rel=2e-3)


def test_white_noise_has_the_power_of_its_voxel():
    cube = cube_of(field=np.random.default_rng(0).normal(size=(161, 40, 40)))
    found = Analyzer(cube).spherical(taper=None, bins=[0.1, 0.3, 0.9] / u.Mpc)
    z = 1420405751.768 / 150e6 - 1
    across = Planck15.comoving_transverse_distance(z).value * 2 * np.deg2rad(1 / 60)
    along = LIGHT * (1 + z) ** 2 / (Planck15.H(z).to_value("m / (s Mpc)") * 1420405751.768) * 0.2e6
    np.testing.assert_allclose(found.power, across**2 * along, rtol=0.03)
    np.testing.assert_allclose(found.delta2, found.k**3 * found.power / (2 * np.pi**2), rtol=1e-12)


def test_a_mjy_per_beam_of_3_arcmin_is_1_676_k():
    cube = cube_of(field=1e-3, count=1, pixels=(2, 2), unit="Jy/beam", psf=Psf.gaussian(3 * u.arcmin))
    assert cube.to_kelvin().data[0, 0, 0, 0] == pytest.approx(1.676, rel=1e-3)
