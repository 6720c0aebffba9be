"""BeamImager: images through the beams of an operator (A-projection), corrected for what they leak."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
from pydantic import Field

from instrument import correlations, mat2
from instrument.checked import checked
from instrument.errors import InputError, RefusedError, warn
from instrument.image.base import Imaged, Kept, SolvingImager
from instrument.image.beam_solve import Channel, Corrected, joint, normalised, predicted
from instrument.image.beam_weights import mueller_weights
from instrument.image.cube import StokesCube
from instrument.image.minor import Folding, restored
from instrument.image.pixel_map import PixelMap
from instrument.image.psf import Psf, fit_psf
from instrument.jones.chain import Chain
from instrument.jones.towards import Towards
from instrument.numbers import TOLERANCE
from instrument.observe.directions import LIGHT, lmn
from instrument.observe.grid import ImageGrid
from instrument.predict.base import EVERY, Problem
from instrument.predict.gridded import image_operator
from instrument.predict.operator import STOKES, ImageOperator
from instrument.sky.base import PlacedSky
from instrument.sky.points import PointSky, points_of
from instrument.units import ArrayOf, Direction, Float, unit_vectors
from instrument.visibilities import Visibilities, VisibilitySet
from instrument.visibility_sets import VisibilityFile, as_set

BESIDE = 1e-4  # of a pixel, from its centre to a source: 1.5e-4 rad of phase at 1 arcmin and 800 wavelengths
SAME = 1e-9  # of a frequency or a time, by which data and an operator may differ


@checked
class BeamImager(SolvingImager):
    """Images of the sky before the beams, (F, 4, N, N) in Jy/beam, of visibilities as they were seen through them.

    Every visibility is taken back through the beams of its stations at its time (A^H w V, with all four Stokes
    parameters of each), and every pixel through the inverse of sum w M^H M, the 4 x 4 Mueller matrices that it was seen
    with. Three ways, by what they remove of the leakage:

    - "normalised": that alone. The leakage of a source is gone but for what the sidelobes of others bring: with LOFAR
      79 % of it at the worst of 36 sources, 89 % in the median (docs/reports/aw_correction.md). Little is gained on a
      diffuse sky, whose leakage changes as the PSF does.
    - "joint": I, Q, U, V of the pixels of `mask` (N, N) are solved together by conjugate gradients on the operator; the
      images are what is left, normalised, and the components folded with the fitted PSF. For sources at known places.
    - "predict": Q and U are solved alone, from the Q and U of the visibilities, and what they leak into I and V is
      predicted and taken out. For diffuse polarized skies where I is faint.

    The solutions take at most `iterations`, and end when the visibilities are met to the tolerance of the operator.
    A visibility counts where all four correlations are known, or all that any visibility of the channel has: a Stokes
    parameter that these do not see is NaN there. A channel without any is NaN. Pixels where the noise of a Stokes
    parameter is more than `amplification` times that of the best pixel have no data; `imaged` gives that ratio and the
    condition number of the matrices as maps. `tolerance` is that of an operator that a run makes; `image` takes one
    (`plan.operator`), or sees no beams.
    """

    planes_held: ClassVar[float] = 80  # of one channel: its matrices, the functions of the nodes, the solution
    planes_made: ClassVar[float] = 16  # with model and residual, and five maps in float32
    way: Literal["normalised", "joint", "predict"] = "normalised"
    iterations: Annotated[int, Field(ge=1, le=1000)] = 16
    amplification: Annotated[float, Field(gt=1)] = 10.0
    tolerance: Annotated[float, TOLERANCE] = 1e-5
    mask: Annotated[Any, ArrayOf(bool, (None, None))] | None = None

    def imaged(
        self, visibilities: VisibilitySet | Iterable[Visibilities], operator: ImageOperator | None = None
    ) -> Imaged:
        """The same with the "model" (Jy/pixel) beside them, and how each channel ended under "beam".

        The maps are "amplification" (F, 4, N, N) and "condition" (F, 1, N, N).

        Of the way "joint" the cube is the restored one, and the "residual" stands beside it too.

        The beam towards the phase centre is taken out of the visibilities first, unless it has been; with another taken
        out, or not those of the operator, they are refused (`InputError`).
        """
        given = as_set(visibilities)
        if not isinstance(given, Visibilities | VisibilityFile):
            kept = Kept(self, operator)
            for block in given.blocks():
                kept.add(block)
            return kept.everything()
        done = [self._channel(_channel_of(given, f), operator) for f in range(len(given.freq_hz))]
        first = _channel_of(given, 0)
        if all(found.record["without_data"] == 1.0 for found, _, _ in done):
            if any("singular" in found.record for found, _, _ in done):
                raise RefusedError(
                    "the beam towards the phase centre has no inverse at any station: a polarization is missing, or "
                    "the centre is on a null; nothing to image"
                )
            raise RefusedError(
                f"no visibility within uv_range = {self.uv_range} has all four correlations with a weight above 0: "
                "nothing to image"
            )
        psf = fit_psf(np.stack([psf for _, psf, _ in done]), self.pixel)
        images, models = (np.stack([getattr(found, name) for found, *_ in done]) for name in ("images", "model"))
        beside = {}
        if self.way == "joint":
            for found, *_ in done:
                found.record["polarized"] = _polarized(found.model)
        if self.way != "normalised":
            beside["model"] = self._cube(first, given, models, "Jy/pixel")
        if self.way == "joint":
            beside["residual"] = self._cube(first, given, images, "Jy/beam")
            images = images + self._restored(models, psf)
        cube = self._cube(first, given, images, "Jy/beam").with_psf(psf)
        made = np.stack([maps for *_, maps in done])
        text = f"noise over that of the best pixel; above {self.amplification:g} a pixel has no data"
        maps = {
            "amplification": PixelMap(made[:, :4], cube, text),
            "condition": PixelMap(made[:, 4:], cube, "condition number of the Mueller matrix of a pixel"),
        }
        return Imaged(cube, beside, {"beam": [found.record for found, *_ in done]}, maps)

    @property
    def through_beams(self) -> bool:
        """It does nothing else."""
        return True

    @property
    def operator_tolerance(self) -> float:
        """As it was asked for."""
        return self.tolerance

    @property
    def operator_passes(self) -> float:
        """Two for the PSF, and those of the solution, at most."""
        return 2.0 + {"normalised": 1, "joint": 2 * self.iterations + 2, "predict": self.iterations + 3}[self.way]

    def error(self) -> str:
        """That of the operator."""
        return f"operator {self.tolerance:.0e} of |V|"

    def _restored(self, models: Float, psf: Psf) -> Float:
        """Models folded with the Gaussian of each channel; as points where none could be fitted."""
        folding, out = Folding(models.shape[2:]), np.array(models)
        for image, *lobe in zip(out, psf.major_rad, psf.minor_rad, psf.angle_rad, strict=True):
            if np.isfinite(lobe).all() and min(lobe[:2]) > 0:
                image[:] = restored(image, (lobe[0], lobe[1], lobe[2]), self.pixel, folding)
        return out

    def for_sky(self, sky: PlacedSky, centre: Direction) -> Self:
        """With a mask of the pixels of the sources of a list, where the way needs one and has none.

        Warns of sources that lie beside the centres of their pixels: no component is where they are.
        """
        listed = points_of(sky)
        if self.way != "joint" or self.mask is not None or listed is None:
            return self
        l, m, _ = lmn(unit_vectors(*listed.directions()), centre).T
        x, y = (np.rint(a / self.pixel).astype(int) + self.pixels // 2 for a in (-l, m))
        inside = (x >= 0) & (x < self.pixels) & (y >= 0) & (y < self.pixels)
        off = np.hypot(-l / self.pixel - (x - self.pixels // 2), m / self.pixel - (y - self.pixels // 2))[inside]
        if (beside := int((off > BESIDE).sum())) > 0:
            warn(
                f"{beside} of {len(off)} sources lie beside the centre of their pixel, by up to {off.max():.2g} "
                "pixels: components at pixels are not where they are, and leave much of them; take another pixel"
            )
        mask = np.zeros((self.pixels, self.pixels), bool)
        mask[y[inside], x[inside]] = True
        return self.with_fields(mask=mask)

    def _cube(self, first: Visibilities, given: Any, data: Any, unit: Any) -> StokesCube:
        from astropy import units as u

        return StokesCube(
            data=data, frequencies=given.freq_hz * u.Hz, pixel=self.pixel * u.rad, unit=unit, centre=first.phase_centre,
            constants="data",
        )  # fmt: skip

    def _channel(self, block: Visibilities, operator: ImageOperator | None) -> tuple[Corrected, Float, Any]:
        """The images of one channel, its PSF (N, N), and the maps of its matrices (5, N, N)."""
        grid = self.grid(block.phase_centre)
        operator = operator or self._plain(block, grid)
        operator.demand(grid, self.uv_range)
        operator = operator.within(self.uv_range)
        known, whole = _known(block), block.effective_weight.any()
        block, centre = _without_centre(block, operator.problem.chain, known)
        weight = correlations.whole(block.effective_weight, known) * np.ones(block.data.shape[:3])
        weight = weight * _within(block, self.uv_range)
        if not weight.any():
            blank = np.full((4, *grid.pixels), np.nan)
            none = np.full((5, *grid.pixels), np.nan, np.float32)
            lost = {"singular": 1.0} if whole and not block.effective_weight.any() else {}
            return Corrected(blank, blank, {"without_data": 1.0, **lost}), blank[0], none
        channel = _place(block, operator)
        problem = operator.problem.block(EVERY, channel).between(block.antenna1, block.antenna2)
        weights = mueller_weights(problem, grid, weight[:, 0], self.amplification, centre, known)
        seen = Channel(operator, channel, (block.antenna1, block.antenna2), block.data, weight, weights, centre, known)
        if self.way == "joint":
            if self.mask is None or self.mask.shape != grid.pixels or not (self.mask & weights.usable).any():
                raise InputError(
                    f"way = 'joint' needs mask, bool {grid.pixels}, true where sources are, somewhere within the beam"
                )
            found = joint(seen, self.mask, self.iterations, self.tolerance)
        elif self.way == "predict":
            found = predicted(seen, self.iterations, self.tolerance)
        else:
            found = normalised(seen)
        found.record["condition"] = float(np.max(weights.condition[weights.usable]))
        found.record["without_data"] = float(np.mean(~weights.usable))
        if len(weights.stokes) < len(STOKES):
            found.record["stokes"] = "".join("IQUV"[s] for s in weights.stokes)
        return found, self._psf(seen), weights.maps

    def _psf(self, seen: Channel) -> Float:
        """What a point of 1 Jy in I at the centre becomes in I, without any correction but for its own matrix.

        In the first of I, Q, U, V that is seen.
        """
        point, first = np.zeros((4, self.pixels, self.pixels)), seen.weights.stokes[0]
        middle = self.pixels // 2
        point[first, middle, middle] = 1.0
        image = seen.back(seen.seen(point), (first,))[first]
        return np.asarray(image / image[middle, middle])

    def _plain(self, block: Visibilities, grid: ImageGrid) -> ImageOperator:
        """An operator without beams, for data of which none are known."""
        a, b = block.antenna1, block.antenna2
        sky = PointSky.at(block.phase_centre.skycoord, [[1.0, 0.0, 0.0, 0.0]])
        return image_operator(Problem(block.at, Chain(), sky, a, b, block.integration_s), grid, self.tolerance)


def _polarized(model: Float) -> float:
    """The largest sqrt(Q² + U²) / I of the components of a model (4, N, N); NaN without any."""
    i, q, u, _ = model[:, model[0] > 0]
    return float(np.max(np.hypot(q, u) / i, initial=0.0)) if len(i) else float("nan")


def _channel_of(given: Visibilities | VisibilityFile, channel: int) -> Visibilities:
    """One channel of a set, all its times."""
    one = slice(channel, channel + 1)
    return given.block(EVERY, one) if isinstance(given, Visibilities) else Visibilities.of(given.store, EVERY, one)


def _known(block: Visibilities) -> Any:
    """Which correlations any visibility of a channel has, bool (2, 2)."""
    weight = block.effective_weight
    found = (weight > 0).any(axis=(0, 1, 2)) if weight.ndim == correlations.APART else correlations.ALL_FOUR
    return found if found.any() else correlations.ALL_FOUR


def _without_centre(block: Visibilities, beams: Chain, known: Any) -> tuple[Visibilities, Any]:
    """Visibilities without the beam towards their phase centre, and what took it out (T, 1, A, 2, 2).

    As they are where correlations are missing, of which every one without the beam is made.
    """
    if not beams.terms or (not known.all() and block.beam_state.removed != "centre"):
        return block, None
    state = block.beam_state
    if state.removed == "centre" and (state.other or state.towards != block.phase_centre):
        raise InputError(f"these visibilities have had a beam taken out that is not that of the operator: {state}")
    taken = Towards(chain=beams)
    inverse = mat2.inverse(taken.jones(block.at)[:, :, :, 0])
    inverse = np.where(np.isfinite(inverse).all(axis=(-2, -1), keepdims=True), inverse, 0.0)
    inverse = np.broadcast_to(inverse, (*block.at.shape[:3], 2, 2))
    return (block if state.removed == "centre" else block.corrected(taken)), inverse


def _within(block: Visibilities, uv_range: tuple[float, float] | None) -> Any:
    """Where the visibilities of one channel are within a uv range, (T, 1, B)."""
    low, high = uv_range or (0.0, np.inf)
    length = np.hypot(block.uvw_m[..., 0], block.uvw_m[..., 1]) * (block.freq_hz[0] / LIGHT)
    return ((length >= low) & (length <= high))[:, None]


def _place(block: Visibilities, operator: ImageOperator) -> slice:
    """Which channel of an operator a channel is; raises `InputError` where times, stations or channel are others."""
    at = operator.problem.at
    if block.layout.names != at.layout.names:
        raise InputError("the operator is of other stations than the visibilities, or in another order")
    f = int(np.argmin(np.abs(at.freq_hz - block.freq_hz[0])))
    same = len(at.slots_s) == len(block.at.slots_s) and np.all(np.abs(at.slots_s - block.at.slots_s) <= 1e-3)
    if not same or abs(at.freq_hz[f] / block.freq_hz[0] - 1) > SAME:
        raise InputError(
            "the operator has not the times and channels of the visibilities: prepare it for the same scene"
        )
    return slice(f, f + 1)
