"""Imagers: each claim of their contract can fail, and a stranger's works from a scene file."""

from dataclasses import replace
from typing import ClassVar

import numpy as np
import pytest
from astropy import units as u

from instrument import AnyImager, Imager, InputError, StokesCube
from instrument.conformance import check, imagers
from instrument.conformance.bench import Broken
from instrument.errors import RefusedError
from instrument.image.base import Kept
from instrument.pipeline.scene_file import parse
from instrument.pipeline.scene_text import override, read_tables
from instrument.visibility_sets import as_set

SIZE = {"pixels": 32, "pixel": 8 * u.arcmin}


def of(cube, data):
    return StokesCube(data, cube.freq_hz * u.Hz, cube.pixel_rad * u.rad, cube.unit, cube.centre)


class Spoilt(AnyImager):
    """Dirty images, spoilt: each class below in one way."""

    def dirty(self, visibilities, **more):
        settings = {"pixels": self.pixels, "pixel": self.pixel * u.rad, "uv_range": self.uv_range, **more}
        return Imager(**settings).image(visibilities)

    def image(self, visibilities, operator=None):
        return self.spoilt(self.dirty(visibilities))

    def spoilt(self, cube):
        return cube


class Mirrored(Spoilt):
    def spoilt(self, cube):
        return of(cube, np.roll(cube.data[..., ::-1], 1, axis=-1))


class Loud(Spoilt):
    def spoilt(self, cube):
        return of(cube, 1.1 * cube.data)


class WithoutV(Spoilt):
    def spoilt(self, cube):
        return of(cube, cube.data * np.array([1, 1, 1, 0])[:, None, None])


class Smaller(Spoilt):
    def spoilt(self, cube):
        return of(cube, cube.data[..., 1:-1, 1:-1])


class FirstBlock(Spoilt):
    def image(self, visibilities, operator=None):
        return self.dirty(next(iter(as_set(visibilities).blocks())))


class SeesFlagged(Spoilt):
    def image(self, visibilities, operator=None):
        blocks = list(as_set(visibilities).blocks())
        bare = [replace(b.with_data(np.nan_to_num(b.data)), flag=np.zeros((1, 1, 1), bool)) for b in blocks]
        return self.dirty(bare)


class Everything(Spoilt):
    def image(self, visibilities, operator=None):
        return self.dirty(visibilities, uv_range=None)


class Remembers(Spoilt):
    calls: ClassVar[list] = []

    def spoilt(self, cube):
        self.calls.append(1)
        return of(cube, cube.data + 1e-4 * len(self.calls))


def test_what_only_gives_dirty_images_keeps_the_contract_blocks_and_all():
    assert check(Spoilt(**SIZE)).passed, str(check(Spoilt(**SIZE)))


@pytest.mark.parametrize(
    ("imager", "claim"),
    [
        (Mirrored, imagers.east_is_left_and_north_is_up),
        (Loud, imagers.a_point_of_1_jy_has_a_peak_of_1_in_each_stokes_parameter),
        (WithoutV, imagers.a_point_of_1_jy_has_a_peak_of_1_in_each_stokes_parameter),
        (Smaller, imagers.its_cube_is_channels_4_pixels_pixels_about_the_phase_centre),
        (FirstBlock, imagers.blocks_give_the_image_of_the_whole),
        (SeesFlagged, imagers.what_is_flagged_is_not_seen),
        (SeesFlagged, imagers.a_flagged_correlation_is_not_seen_and_spoils_no_other),
        (Everything, imagers.baselines_outside_its_uv_range_are_not_seen),
        (Remembers, imagers.a_call_of_image_has_no_side_effects),
    ],
)
def test_each_claim_fails_for_what_breaks_it(imager, claim):
    with pytest.raises(Broken):
        claim(imager(**SIZE))


def test_blocks_that_were_kept_are_gone_with_their_file():
    kept = Kept(Spoilt(**SIZE))
    kept.add(imagers._seen((1.0, 0.0, 0.0, 0.0)))
    assert kept.path.exists()
    kept.finish()
    assert not kept.path.parent.exists()
    with pytest.raises(RefusedError, match="nothing to image"):
        Kept(Spoilt(**SIZE)).finish()


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        (["image.kind='dirti'"], r"\[image\] kind = 'dirti': did you mean 'dirty'"),
        (["image.kind=3"], r"\[image\] kind = 3: known: beam, clean, dirty"),
        (["image.pixels=31"], r"\[image\] pixels = 31 must be even"),
    ],
)
def test_a_wrong_kind_is_one_line_that_names_it(settings, said):
    with pytest.raises(InputError, match=said) as error:
        parse(override(read_tables("mock-grid"), settings))
    assert "\n" not in str(error.value)


def test_an_imager_of_a_stranger_is_taken_from_a_scene_file_and_the_gridder_agrees_with_its_plain_sum(stranger):
    stranger("imagers", "summed", "Summed")
    tables = override(read_tables("mock-grid"), ["image.kind='summed'", "image.pixels=32", "image.pixel='8 arcmin'"])
    del tables["image"]["accuracy"]  # that of a gridder
    summed = parse(tables).stages["image"].imager
    seen = imagers._seen((1.0, 0.5, -0.25, 0.125), 5, 3, summed.pixel)
    for uv_range in (None, (20.0, 60.0)):
        due = summed.with_fields(uv_range=uv_range).image(seen).data
        found = Imager(**SIZE, uv_range=uv_range, accuracy=1e-11).image(seen).data
        assert np.abs(found - due).max() < 1e-10 * np.abs(due).max()
