"""CleanImager: deconvolved images of I, Q, U, V, by minor cycles in images and major cycles in visibilities."""

from __future__ import annotations

from collections.abc import Iterable

from instrument.checked import checked
from instrument.image.base import Imaged
from instrument.image.clean_settings import Cleaning
from instrument.image.cycles import Cycles
from instrument.predict.operator import ImageOperator
from instrument.visibilities import Visibilities, VisibilitySet


@checked
class CleanImager(Cleaning):
    """CLEAN: components at the peaks, taken out of the images with the PSF and then out of the visibilities themselves.

    The cube that `image` gives is the restored one: components folded with the Gaussian fitted to the PSF, and the
    residual; `imaged` gives model (Jy/pixel) and residual too. `algorithm` "hogbom" has points, "multiscale" has
    `scales` (full sizes of tapered quadratics, 0 for points; unless given, points, and twice the beam and twice that
    and so on up to a quarter of the image).

    `peaks` says where components may be: "each" looks for those of I, of Q and U by their P, and of V by themselves;
    "joint" for those of sqrt(I2 + Q2 + U2 + V2), one list of places for all; "I" for those of I, where all four are
    taken. Nothing is divided by I. `mask` (N, N) keeps them to where it is true; `auto_mask` to where the residual was
    above so many times its noise in this major cycle or one before; `negative` = False allows none below 0 in I. With
    `terms` channels are joined: peaks are looked for in their weighted mean, and components follow a polynomial of so
    many terms in frequency (as many as channels: any spectrum).

    A component is `gain` of a peak. A minor cycle takes `major_gain` of the highest peak, then visibilities are gone
    through anew, up to `cycles` times. It ends at `threshold`, at `sigma` times the noise (1.48 of the median
    |residual|), after `iterations` components, or when the residual rises; which it was is in `imaged(...).record`.
    A visibility counts where all of its correlations are known, unless a channel has none that knows one of them.

    In a run `beams` = True looks through those of the scene, by an operator of `tolerance`.

    `backend` "radler" has the minor cycles done by that library, in float32 (extra `radler`).
    """

    def imaged(
        self, visibilities: VisibilitySet | Iterable[Visibilities], operator: ImageOperator | None = None
    ) -> Imaged:
        """Restored images, and `beside` them "model" (Jy/pixel) and "residual"; how it ended under "clean".

        With an operator the residual visibilities are V - A x, and images and model are of the sky before the beams of
        the operator: what is found is taken through the inverse of their mean Mueller matrix at its place, where
        that is above 5 % of its largest; elsewhere is no data.
        """
        return Cycles(self, visibilities, operator).run()

    def error(self) -> str:
        """That of the gridding, of what is not cleaned."""
        through = f", operator {self.tolerance:.0e} of |V|" if self.beams else ""
        return (
            f"gridding {self.accuracy:.0e} of the mean |V|{through}; what is below the end of CLEAN is not deconvolved"
        )
