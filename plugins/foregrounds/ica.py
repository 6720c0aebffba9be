"""Independent components, by FastICA of scikit-learn where it is installed."""

from __future__ import annotations

import warnings
from dataclasses import replace
from typing import Annotated, ClassVar

import numpy as np

from instrument.errors import Outcome, PluginError
from instrument.foreground.base import ForegroundRemover, Separation
from instrument.foreground.linear import projection, seen
from instrument.foreground.maps import StokesMaps
from instrument.units import Count, Seed, Whole


class FastICA(ForegroundRemover):
    """Projects out the `components` spectra whose maps are least Gaussian (Hyvarinen 1999), mean maps included.

    They span what as many principal components of the maps less their means do: other maps, the same residual.
    """

    needs: ClassVar[dict[str, str]] = {"sklearn": "scikit-learn"}

    components: Annotated[int, Whole(at_least=0)] = 4
    iterations: Count = 200
    seed: Seed = 0

    def separate(self, given: StokesMaps) -> Separation:
        """Foreground A A^+ (X - mean) + mean; raises `PluginError` where scikit-learn is not installed."""
        maps = given.plane
        try:
            from sklearn.decomposition import FastICA as Fast
            from sklearn.exceptions import ConvergenceWarning
        except ImportError:
            raise PluginError('ica needs scikit-learn: pip install "instrument[ica]"') from None
        n, f = self.components, len(maps)
        if not 0 < n < f:
            return projection(maps, np.eye(f)[:, :n], Outcome.CONVERGED, f"{n} components of {f} channels: no search")
        found = maps[:, seen(maps)].astype(float)
        fit = Fast(n, whiten="unit-variance", max_iter=self.iterations, random_state=self.seed)
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always", ConvergenceWarning)
            fit.fit(found.T)
        stopped = any(issubclass(w.category, ConvergenceWarning) for w in said)
        outcome = Outcome.ITERATION_LIMIT if stopped else Outcome.CONVERGED
        parts = projection(maps, fit.mixing_, outcome, f"{n} independent components, {fit.n_iter_} iterations")
        assert parts.operator is not None
        mean = found.mean(axis=1)
        return replace(parts, offset=mean - parts.operator @ mean)
