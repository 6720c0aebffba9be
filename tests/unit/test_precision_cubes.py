"""Contests of what is made of cubes: their truth is right, they tell good from bad, a stranger's imager is drawn in."""

import numpy as np
import pytest

from instrument import Analyzer, Imager, InputError
from instrument.precision import Contest, Entry, Form, Trial, contests_of, faraday, imagers, photometry, spectra
from instrument.precision.advice import advised, counted, crossovers, peers_ahead
from instrument.precision.contest import OVER, RIGHT, UNSET, WRONG, Row, measured

QUICK = Form(quick=True)


def row(contest, plugin, asked, error, seconds, outcome=RIGHT, peer=False):
    return Row(contest, plugin, "knob", asked, error, error, seconds, 0.0, 0.0, outcome, peer=peer)


def contest(name="sums", **more):
    return Contest(
        name=name, kind="sums", knob="tolerance", values=(1e-2,), entries=(), judge=lambda found, asked: Trial(0, 0),
        error="of a number", error_user="the same", truth="zero", **more,
    )  # fmt: skip


# What contests say -------------------------------------------------------------------------------------------------


def test_the_size_at_which_another_is_quickest_is_named():
    small, large = (
        contest("small", family="sums", size=10, size_word="numbers"),
        contest("large", family="sums", size=99),
    )
    found = [
        (large, [row("large", "a", 1, 1e-7, 9.0), row("large", "b", 1, 1e-7, 2.0)]),
        (small, [row("small", "a", 1, 1e-7, 1.0), row("small", "b", 1, 1e-7, 2.0)]),
    ]
    assert crossovers(found) == ["sums, error 1e-02 to 1e-06, quickest: a, b from 99 numbers on"]
    assert crossovers(found[:1]) == []


def test_a_peer_that_leads_is_named_with_how_much():
    rows = [row("c", "ours", 1, 1e-5, 3.0), row("c", "theirs", 1, 1e-3, 1.5, peer=True)]
    assert peers_ahead([(contest(), rows)]) == ["sums: theirs is ahead, at 1e-02 2 times"]
    assert peers_ahead([(contest(), rows[:1])]) == []


def test_what_is_wrong_is_counted_even_where_nothing_is():
    assert counted([row("c", "a", 1, 1e-3, 1.0)]) == f"1 right, 0 {WRONG}"
    assert counted([row("c", "a", 1, 1e-3, 1.0, WRONG), row("c", "a", 1, np.nan, 1.0, "refused: no")]) == (
        f"0 right, 1 refused, 1 {WRONG}"
    )


def test_an_entry_without_the_knob_stands_there_without_a_value():
    one = contest(honoured=True)
    rows = measured(
        Contest(**{**vars(one), "entries": (Entry("exact", lambda asked: asked, (UNSET,)),),
                   "judge": lambda found, asked: Trial(1e-3, 1e-3)}), quick=True,
    )  # fmt: skip
    assert [r.outcome for r in rows] == [RIGHT] and np.isnan(rows[0].asked)
    assert "take exact (" in advised(one, rows)


def test_a_promise_of_a_peer_is_not_ours():
    def rows(peer):
        made = Contest(**{**vars(contest(honoured=True)), "entries": (Entry("x", lambda asked: asked, peer=peer),),
                          "judge": lambda found, asked: Trial(2 * asked, 0)})  # fmt: skip
        return [r.outcome for r in measured(made, quick=True)]

    assert rows(peer=True) == [RIGHT] and rows(peer=False) == [OVER]


def test_the_first_answer_is_told_apart_from_the_others():
    import time

    calls = []

    def answer(asked):
        time.sleep(0.0 if calls else 0.05)
        calls.append(asked)

    made = Contest(**{**vars(contest()), "entries": (Entry("x", answer),)})
    (found,) = measured(made, quick=True)
    assert found.first > 0.05 > 10 * found.seconds and found.compiled == 0 and found.repeats == 3


def test_stages_that_are_several_take_no_plugins():
    with pytest.raises(InputError, match="analyze is photometry, rm-synthesis, rm-clean, spectra, foregrounds"):
        contests_of("analyze", ("gmca",), QUICK)


# Their truths -------------------------------------------------------------------------------------------------------


def test_the_truth_of_images_is_that_of_a_float64_sum():
    data = imagers.seen(6, 2)
    l, m = np.array([0.05, -0.02, 0.0]), np.array([-0.03, 0.06, 0.0])
    uvw = data.uvw_m.reshape(-1, 3) * (data.freq_hz[0] / 299792458)
    n = np.sqrt(1 - l**2 - m**2) - 1
    plain = np.exp(2j * np.pi * (uvw @ np.stack([l, m, n])))
    due = (data.stokes()[:, 0].reshape(-1, 4).T @ plain).real / len(uvw)
    np.testing.assert_allclose(imagers.plain_sum(data, l, m), due, atol=1e-12 * np.abs(due).max())


@pytest.mark.parametrize("accuracy", [1e-3, 1e-6, 1e-9])
def test_an_imager_keeps_its_accuracy_and_one_that_is_off_does_not(accuracy):
    (one,) = imagers.contests({"dirty": Imager}, QUICK)
    planes = one.entries[0].answer(accuracy)
    assert one.judge(planes, accuracy).error <= accuracy
    assert one.judge(planes + 200 * accuracy, accuracy).error > accuracy  # the sources have 220 Jy
    assert one.judge(planes[:, ::-1], accuracy).error > 0.1


def test_a_point_in_the_corner_is_within_the_accuracy_of_the_mean_amplitude():
    """It was 7 times beyond the accuracy of the rms of the image, as was promised before."""
    from astropy import units as u

    data, n = imagers.seen(12, 4), 64
    pixel = float(np.deg2rad(2)) / n
    x, y = pixel * n / 2, -pixel * n / 2
    w = -(x**2 + y**2) / (1 + np.sqrt(1 - x**2 - y**2))
    fringe = np.exp(-2j * np.pi * (data.uvw_m @ np.array([x, y, w])) * (data.freq_hz[0] / 299792458))
    point = np.zeros(data.data.shape, complex)
    point[..., 0, 0] = point[..., 1, 1] = fringe[:, None]
    seen = data.with_data(point)
    side = np.arange(n) - n // 2
    l, m = (v.ravel() for v in np.meshgrid(-pixel * side, pixel * side))
    due = imagers.plain_sum(seen, l, m)[0]
    assert due[0] == pytest.approx(1, abs=1e-12)
    for accuracy in (1e-3, 1e-5, 1e-7):
        found = Imager(pixels=n, pixel=pixel * u.rad, accuracy=accuracy).image(seen).data[0, 0].ravel()
        assert np.abs(found - due).max() <= accuracy


def test_the_truth_of_faraday_synthesis_is_that_of_a_float64_sum():
    p = faraday._sources(3, 3)[2].reshape(161, -1)
    lambda2 = (299792458 / faraday.FREQ) ** 2
    due = np.exp(-2j * np.outer(faraday.DEPTHS, lambda2 - lambda2.mean())) @ p / 161
    np.testing.assert_allclose(faraday._plain_sum(p), due, atol=1e-12)


def test_depths_of_peaks_are_told_between_the_steps():
    f = np.exp(-(((faraday.DEPTHS[:, None] - [7.1, -12.55]) / 3) ** 2))
    np.testing.assert_allclose(faraday._peaks(f), [7.1, -12.55], atol=2e-3)


def test_rm_clean_that_stops_early_is_no_convergence_and_a_lie_is_wrong():
    (one,) = faraday.clean(QUICK)
    entries = {entry.plugin: entry for entry in one.entries}
    assert one.judge(entries["instrument (cutoff)"].answer(1e-4), 1e-4)[::2] == (pytest.approx(2e-4, rel=0.5), RIGHT)
    found = one.judge(entries["instrument (iterations)"].answer(10.0), 10.0)
    assert found.outcome == "ITERATION_LIMIT" and found.error > 0.1


def test_a_clean_that_left_too_much_and_says_converged_is_wrong():
    from dataclasses import replace

    dirty = Analyzer(faraday._cube(faraday._sources(2, 2)[2], kind=float)).rm_synthesis(faraday.DEPTHS)
    cleaned = dirty.clean(cutoff=1e-3)
    assert faraday._ended(cleaned) == RIGHT
    assert faraday._ended(replace(cleaned, components=0.9 * cleaned.components)) == WRONG


def test_tapers_are_told_apart_by_their_floors():
    floor, known = spectra._floor(QUICK, 64, 8), spectra._known(QUICK, 64, 32)
    error = {entry.plugin: floor.judge(entry.answer(8.0), 8.0).error for entry in floor.entries}
    assert error["taper none"] > 1e-5 > error["taper hann"] > 1e-9 > error["taper blackman-harris"] > 1e-14
    assert error["taper blackman-harris-7"] < 1e-16
    by = {entry.plugin: known.judge(entry.answer(UNSET), UNSET).error for entry in known.entries}
    assert by["taper hann, images hann"] < 0.5 * by["taper none, images none"]


def test_photometry_beats_the_pixels_and_a_solution_cut_short_is_not_right():
    noise, iterated = photometry.contests(QUICK)
    found = {entry.plugin: noise.judge(entry.answer(1.0), 1.0).error for entry in noise.entries}
    assert found["joint photometry"] < 1e-2 < 0.1 < found["pixels of the dirty image"]
    (entry,) = iterated.entries
    solution = entry.answer(1e-6)
    assert iterated.judge(solution, 1e-6).outcome == RIGHT
    assert iterated.judge(solution, 1e-12).outcome == WRONG  # so much was not reached
