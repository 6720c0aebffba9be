"""2x2 algebra against closed forms and LAPACK, at ordinary and at extreme scales."""

import numpy as np
import pytest

from instrument import mat2

RNG = np.random.default_rng(0)
STACK = RNG.standard_normal((5, 1, 7, 2, 2, 2)).view(complex)[..., 0]
OTHER = RNG.standard_normal((3, 7, 2, 2, 2)).view(complex)[..., 0]


def rotation(angle):
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


def of_condition(k, seed=0):
    """Random matrices (9, 2, 2) of a given condition number: U diag(1, 1/k) V."""
    rng = np.random.default_rng(seed)
    phase = np.exp(2j * np.pi * rng.random((9, 2)))
    u = np.stack([rotation(a) for a in rng.uniform(0, 6, 9)]) * phase[:, None]
    v = np.stack([rotation(a) for a in rng.uniform(0, 6, 9)])
    return (u * np.array([1, 1 / k])) @ v


def test_pack_broadcasts_and_puts_entries_in_rows():
    found = mat2.pack(1, np.array([2.0, 3.0]), 4j, 5)
    np.testing.assert_array_equal(found, [[[1, 2], [4j, 5]], [[1, 3], [4j, 5]]])
    assert found.dtype == complex


def test_pack_keeps_single_precision():
    assert mat2.pack(*np.ones(4, np.complex64)).dtype == np.complex64


def test_mul_is_matmul_with_broadcasting():
    # 2 products and a sum: 4 roundings of numbers of order 1
    np.testing.assert_allclose(mat2.mul(STACK, OTHER), STACK @ OTHER, rtol=0, atol=5e-15)
    assert mat2.mul(STACK, OTHER).shape == (5, 3, 7, 2, 2)


def test_herm_is_the_conjugate_transpose_and_an_involution():
    np.testing.assert_array_equal(mat2.herm(STACK)[..., 0, 1], STACK[..., 1, 0].conj())
    np.testing.assert_array_equal(mat2.herm(mat2.herm(STACK)), STACK)


def test_det_is_that_of_lapack():
    np.testing.assert_allclose(mat2.det(STACK), np.linalg.det(STACK), rtol=0, atol=1e-14)


def test_sandwich_keeps_a_hermitian_matrix_hermitian():
    b = OTHER + mat2.herm(OTHER)
    found = mat2.sandwich(STACK, b, STACK)
    np.testing.assert_allclose(found, STACK @ b @ mat2.herm(STACK), atol=1e-13)
    np.testing.assert_allclose(found, mat2.herm(found), atol=1e-13)


@pytest.mark.parametrize(("times", "channels", "stations", "baselines"), [(3, 2, 4, 5), (3, 1, 1, 5), (2, 2, 3, 0)])
def test_matrices_of_stations_are_taken_to_their_baselines(times, channels, stations, baselines):
    """As `sandwich` of the matrices picked out; one for all stations, one for all times, none at all."""
    rng = np.random.default_rng(3)
    jones = rng.standard_normal((times, 1, stations, 2, 2, 2)).view(complex)[..., 0]
    v = rng.standard_normal((times, channels, baselines, 2, 2, 2)).view(complex)[..., 0]
    one, other = rng.integers(max(stations, 4), size=(2, baselines))
    a, b = (np.zeros(baselines, int) if stations == 1 else p for p in (one, other))
    for j in (jones, jones[:1]):
        due = mat2.sandwich(j[:, :, a], v, j[:, :, b])
        found = mat2.between(j, v, one, other)
        assert found.shape == due.shape == v.shape
        np.testing.assert_allclose(found, due, rtol=0, atol=1e-14 * np.abs(due).max(initial=1.0))
    if baselines:
        v[1, 0, 2] = np.nan
        assert np.isnan(mat2.between(jones, v, one, other)).sum() == 4


def test_inverse_of_a_known_matrix():
    np.testing.assert_allclose(mat2.inverse(np.array([[1, 2], [3, 4 + 0j]])), [[-2, 1], [1.5, -0.5]], rtol=1e-15)


@pytest.mark.parametrize("scale", [1e-300, 1e-200, 1e-100, 1e-8, 1.0, 1e8, 1e100, 1e200, 1e300])
def test_inverse_does_not_depend_on_the_scale(scale):
    expected = np.linalg.inv(OTHER)
    # rtol of the largest entry: condition 1e2 at most here, times a few roundings
    error = np.abs(mat2.inverse(OTHER * scale) * scale - expected).max(axis=(-2, -1))
    assert (error <= 1e-13 * np.abs(expected).max(axis=(-2, -1))).all()


@pytest.mark.parametrize("scale", [1e-200, 1.0, 1e200])
@pytest.mark.parametrize("k", [1.0, 1e3, 1e6, 1e9, 1e12])
def test_inverse_is_as_good_as_the_condition_number_allows(k, scale):
    a = of_condition(k)
    # backward stable: A A^-1 off by k times the rounding of the entries of A, which are of order 1
    residual = np.abs(mat2.mul(a * scale, mat2.inverse(a * scale)) - mat2.IDENTITY).max()
    assert residual <= 8 * k * np.finfo(float).eps


@pytest.mark.parametrize(
    "singular",
    [
        np.zeros((2, 2)),
        [[1, 2], [2, 4]],
        [[1e-200, 2e-200], [2e-200, 4e-200]],
        [[0, 1], [0, 0]],
        [[1, 1], [1, 1 + 2e-16]],
        [[np.nan, 0], [0, 1]],
        [[np.inf, 0], [0, 1]],
        [[1, np.nan], [0, 1]],
    ],
)
def test_the_inverse_of_a_singular_or_broken_matrix_is_nan_and_silent(singular):
    with np.errstate(all="raise"):
        found = mat2.inverse(np.array(singular, complex))
    assert np.isnan(found).all()


def test_a_singular_matrix_does_not_spoil_its_neighbours():
    stack = np.stack([OTHER[0, 0], np.zeros((2, 2)), OTHER[0, 1]])
    found = mat2.inverse(stack)
    assert np.isnan(found[1]).all()
    np.testing.assert_allclose(found[[0, 2]], np.linalg.inv(stack[[0, 2]]), rtol=1e-12)


def test_singular_values_are_those_of_lapack():
    high, low = mat2.singular_values(STACK)
    expected = np.linalg.svd(STACK, compute_uv=False)
    np.testing.assert_allclose(high, expected[..., 0], rtol=1e-14)
    np.testing.assert_allclose(low, expected[..., 1], rtol=1e-13)


@pytest.mark.parametrize("k", [1.0, 1 + 1e-7, 1e3, 1e6, 1e9, 1e12])
def test_condition_numbers_are_right_up_to_1e12(k):
    # the entries are rounded to 1e-16, which is k * 1e-16 of the smallest singular value; near k = 1: the next test
    np.testing.assert_allclose(mat2.condition(of_condition(k)), k, rtol=max(8e-16 * k, 5e-8))


@pytest.mark.parametrize("excess", [1e-3, 1e-6, 1e-9, 1e-12])
def test_a_condition_number_near_1_keeps_the_digits_of_its_excess(excess):
    # IXR = ((k + 1) / (k - 1))^2 needs k - 1: the rounding of the entries allows it to 1e-15
    np.testing.assert_allclose(mat2.condition(of_condition(1 + excess)) - 1, excess, rtol=0, atol=2e-15)


def test_the_singular_values_of_a_multiple_of_a_unitary_matrix_are_one_number():
    """[[1, d], [-d*, 1]]: its IXR is infinite, where a root and a quotient that round apart make 1e32 of it."""
    d = np.random.default_rng(3).uniform(-1, 1, (200, 2)) @ [1, 1j]
    high, low = mat2.singular_values(mat2.pack(1, d, -d.conj(), 1))
    assert np.array_equal(high, low)


def test_a_unitary_matrix_has_condition_1():
    turned = np.exp(0.3j) * rotation(0.7)
    assert mat2.condition(turned) == pytest.approx(1.0, abs=5e-8)
    assert mat2.condition(np.diag([2.0, 2.0]).astype(complex)) == 1.0


@pytest.mark.parametrize("singular", [np.zeros((2, 2)), [[1, 0], [0, 0]], [[1, 1], [1, 1]]])
def test_a_singular_matrix_has_infinite_condition(singular):
    assert mat2.condition(np.array(singular, complex)) == np.inf


@pytest.mark.parametrize("scale", [1e-200, 1e200])
@pytest.mark.filterwarnings("ignore:.*overflow:RuntimeWarning", "ignore:invalid:RuntimeWarning")
def test_condition_does_not_depend_on_the_scale(scale):
    np.testing.assert_allclose(mat2.condition(OTHER * scale), mat2.condition(OTHER), rtol=1e-13)


@pytest.mark.parametrize("scale", [1e-200, 1e-160, 1e160, 1e200])
@pytest.mark.filterwarnings("ignore:.*overflow:RuntimeWarning", "ignore:invalid:RuntimeWarning")
def test_singular_values_do_not_depend_on_the_scale(scale):
    high, low = (s / scale for s in mat2.singular_values(OTHER * scale))
    expected = np.linalg.svd(OTHER, compute_uv=False)
    np.testing.assert_allclose(high, expected[..., 0], rtol=1e-13)
    np.testing.assert_allclose(low, expected[..., 1], rtol=1e-13)


def test_the_identity_cannot_be_changed():
    with pytest.raises(ValueError, match="read-only"):
        mat2.IDENTITY[0, 0] = 2


def test_nothing_given_is_changed():
    before = STACK.copy()
    mat2.inverse(STACK)
    mat2.sandwich(STACK, STACK, STACK)
    mat2.condition(STACK)
    np.testing.assert_array_equal(STACK, before)
