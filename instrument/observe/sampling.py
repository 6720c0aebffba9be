"""Sampling: the times, channels, stations and directions at which Jones terms and skies are asked."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from instrument.checked import checked
from instrument.errors import InputError
from instrument.observe.directions import EARTH_RATE, EarthFrame, earth_frame, lmn, tangents
from instrument.observe.layout import Layout
from instrument.observe.rising import Rising, rising, rising_seen
from instrument.shown import short_repr
from instrument.units import Direction, Float, Int, instants, plain, unit_vectors


@dataclass(frozen=True)
class Sampling:
    """Where a Jones term is evaluated: T times, F channels, A stations, S directions.

    Everything geometric is worked out when asked for, once. `seen`, `seen_east` (T, S, 3) and `seen_centre` (T, 3)
    override the ITRF directions, the east vectors across them and the phase centre, for work with another program's
    frames; `towards` drops the first two, which belong to the directions. Beams point at `steered`, the phase centre
    unless given: it stays where data are turned to another phase centre. `own_uvw_m` (T, A, 3) are the station
    coordinates of a file, which every fringe then has: another program's Earth differs by 0.5 arcsec.
    """

    __repr__ = short_repr
    layout: Layout
    earth: EarthFrame
    slots_s: Float  # (T,) MJD seconds, UTC: names an integration, used for interpolation and for seeds
    freq_hz: Float  # (F,)
    ra_rad: Float  # (S,)
    dec_rad: Float  # (S,)
    centre: Direction
    seen: Float | None = None
    seen_east: Float | None = None
    seen_centre: Float | None = None
    steered: Direction | None = None
    own_uvw_m: Float | None = None

    @classmethod
    @checked
    def build(
        cls,
        layout: Layout,
        times: Any,
        freq_hz: Float | float,
        ra_rad: Float | float,
        dec_rad: Float | float,
        centre: Direction,
    ) -> Sampling:
        """Sampling at astropy `times` (T,), for ICRS directions (S,) in rad; all finite, frequencies positive."""
        times = instants(times)
        freq_hz = np.atleast_1d(plain(freq_hz, float, "freq_hz", finite=True))
        if np.any(freq_hz <= 0):
            raise InputError(f"freq_hz = {freq_hz.min():g} Hz must be positive")
        return cls(
            layout=layout,
            earth=earth_frame(times, layout.centre_m),
            slots_s=mjd_seconds(times),
            freq_hz=freq_hz,
            ra_rad=np.atleast_1d(plain(ra_rad, float, "ra_rad", finite=True)),
            dec_rad=np.atleast_1d(plain(dec_rad, float, "dec_rad", finite=True)),
            centre=centre,
        )

    @property
    def shape(self) -> tuple[int, int, int, int]:
        """(T, F, A, S)."""
        return len(self.earth), len(self.freq_hz), len(self.layout), len(self.ra_rad)

    @checked
    def block(self, times: slice, channels: slice) -> Sampling:
        """The same for some times and channels."""
        return replace(self._with_times(times), freq_hz=self.freq_hz[channels])

    def some(self, which: Int) -> Sampling:
        """The same for some times, by their indices."""
        return self._with_times(which)

    def every(self, interval_s: float, which: Int) -> Sampling:
        """The same at times counted from the first, every `interval_s`, before and after its own too.

        The first is taken from the Earth as it stands: `slots_s` is rounded to a microsecond.
        """
        from astropy import units as u

        if len(which) and which.min() >= 0 and which.max() < len(self.earth):
            return self.some(which)
        start = times_of(self.slots_s[:1])
        there = self.earth.matrices[0] @ earth_frame(start, self.layout.centre_m).matrices[0].T
        late = float(np.arctan2(there[0, 1], there[0, 0])) / EARTH_RATE
        times = start + (which * interval_s + late) * u.s
        earth, slots = earth_frame(times, self.layout.centre_m), self.slots_s[0] + which * interval_s
        made = replace(self, earth=earth, slots_s=slots, seen=None, seen_east=None, seen_centre=None, own_uvw_m=None)
        return made if self.own_uvw_m is None else replace(made, own_uvw_m=self._turned(made))

    def _turned(self, made: Sampling) -> Float:
        """Own UVW at other times: ours, turned as those of the file are at its nearest time.

        What a rotation leaves of them, nothing where the file has the stations where they are, is taken from there too.
        """
        own, ours = self.own_uvw_m, replace(self, own_uvw_m=None).uvw_m
        assert own is not None
        order = np.argsort(self.slots_s)
        middles = (self.slots_s[order][1:] + self.slots_s[order][:-1]) / 2
        near = order[np.searchsorted(middles, made.slots_s)]
        turn = _rotations(ours, own)
        rest = own - ours @ np.swapaxes(turn, 1, 2)
        return np.asarray(made.uvw_m @ np.swapaxes(turn, 1, 2)[near] + rest[near])

    def regular(self, interval_s: float) -> bool:
        """Whether its times follow each other every `interval_s`, to 10 ns, and are seen from where they are."""
        if self.seen_centre is not None or not np.allclose(np.diff(self.slots_s), interval_s, rtol=0, atol=1e-5):
            return False
        which = np.unique(np.linspace(0, len(self.earth) - 1, 64).round().astype(int))
        made = self.every(interval_s, np.append(-1, which)).earth.matrices[1:]
        return bool(np.abs(made - self.earth.matrices[which]).max() < 1e-8 * EARTH_RATE)

    def _with_times(self, times: Any) -> Sampling:
        return replace(
            self,
            earth=self.earth[times],
            slots_s=self.slots_s[times],
            seen=None if self.seen is None else self.seen[times],
            seen_east=None if self.seen_east is None else self.seen_east[times],
            seen_centre=None if self.seen_centre is None else self.seen_centre[times],
            own_uvw_m=None if self.own_uvw_m is None else self.own_uvw_m[times],
        )

    @checked
    def towards(self, ra_rad: Float, dec_rad: Float) -> Sampling:
        """The same for other directions, ICRS rad (S,)."""
        return replace(self, ra_rad=np.atleast_1d(ra_rad), dec_rad=np.atleast_1d(dec_rad), seen=None, seen_east=None)

    def of(self, directions: Int) -> Sampling:
        """The same for some of its directions, by their indices; what was found of how high they come is kept."""
        made = replace(
            self,
            ra_rad=self.ra_rad[directions],
            dec_rad=self.dec_rad[directions],
            seen=None if self.seen is None else self.seen[:, directions],
            seen_east=None if self.seen_east is None else self.seen_east[:, directions],
        )
        if "rising" in self.__dict__:
            made.__dict__["rising"] = Rising(*(x[directions] for x in self.rising))
        return made

    def at_centre(self) -> Sampling:
        """The same for the phase centre alone."""
        return self.towards(np.array([self.centre.ra_rad]), np.array([self.centre.dec_rad]))

    def one_per_frame(self) -> Sampling:
        """The same for one station of each distinct set of axes (`layout.frames`)."""
        few = self.layout.one_per_frame
        return self if few is self.layout else replace(self, layout=few, own_uvw_m=None)

    @cached_property
    def vectors(self) -> Float:
        """ICRS unit vectors of the directions (S, 3)."""
        return unit_vectors(self.ra_rad, self.dec_rad)

    @cached_property
    def itrf(self) -> Float:
        """Apparent ITRF unit vectors (T, S, 3)."""
        return self.earth.itrf(self.vectors) if self.seen is None else self.seen

    @cached_property
    def centre_itrf(self) -> Float:
        """Apparent ITRF unit vector of the phase centre (T, 3)."""
        if self.seen_centre is not None and self.steered is None:
            return self.seen_centre
        return self.earth.itrf(self.centre.vector[None])[:, 0]

    @property
    def pointing(self) -> Direction:
        """Where beams point: the phase centre, or the one from which data were turned to another."""
        return self.steered or self.centre

    @cached_property
    def pointing_itrf(self) -> Float:
        """Apparent ITRF unit vector of the pointing (T, 3)."""
        if self.seen_centre is not None:
            return self.seen_centre
        return self.earth.itrf(self.pointing.vector[None])[:, 0]

    @cached_property
    def east_itrf(self) -> Float:
        """ITRF unit vectors east of each source, across the line of sight (T, S, 3); north is d x east."""
        if self.seen_east is not None:
            return self.seen_east
        return self.earth.carried(tangents(self.ra_rad, self.dec_rad)[0], self.itrf)

    @cached_property
    def local(self) -> Float:
        """Apparent unit vectors in the axes (p, q, r) of the stations, (T, A, S, 3)."""
        axes = self.layout.axes
        return np.asarray(self.itrf[:, None] @ np.swapaxes(axes, 1, 2)[None])

    @cached_property
    def zenith_angle(self) -> Float:
        """Angle from the normal of the antenna plane, rad (T, A, S)."""
        p, q, r = np.moveaxis(self.local, -1, 0)
        return np.arctan2(np.hypot(p, q), r)

    @cached_property
    def azimuth_cos_sin(self) -> tuple[Float, Float]:
        """Cosine and sine of the azimuth counted from p (east) to q (north), (T, A, S); (1, 0) at the zenith."""
        p, q, _ = np.moveaxis(self.local, -1, 0)
        rho = np.hypot(p, q)
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.where(rho > 0, p / rho, 1.0), np.where(rho > 0, q / rho, 0.0)

    @cached_property
    def rising(self) -> Rising:
        """How high and how low each direction stands, and how near it comes to zenith and horizon; never (T, A, S)."""
        normals = self.layout.axes[self.layout.frames[0], 2]
        if self.seen is None:
            return rising(self.earth, self.slots_s, self.vectors, normals)
        return rising_seen(self.seen, normals)  # by another program

    @property
    def azimuth(self) -> Float:
        """Azimuth as astronomers count it, from q (north) through p (east), rad in 0 to 2 pi (T, A, S)."""
        cos, sin = self.azimuth_cos_sin
        return np.arctan2(cos, sin) % (2 * np.pi)

    @property
    def parallactic_angle(self) -> Float:
        """Angle at each source from north through east to the zenith, rad (T, A, S)."""
        zenith = self.layout.axes[:, 2]
        north = np.cross(self.itrf, self.east_itrf)
        return np.swapaxes(np.arctan2(self.east_itrf @ zenith.T, north @ zenith.T), 1, 2)

    @cached_property
    def lmn(self) -> Float:
        """Direction cosines l, m and n - 1 about the phase centre (S, 3)."""
        return lmn(self.vectors, self.centre)

    @cached_property
    def uvw_m(self) -> Float:
        """Station coordinates u, v, w in m about the array's centre (T, A, 3); u_ab = u_a - u_b."""
        if self.own_uvw_m is not None:
            return self.own_uvw_m
        relative = self.layout.positions_m - self.layout.centre_m
        return relative[None] @ np.swapaxes(self.earth.uvw_axes(self.centre), 1, 2)


def _rotations(ours: Float, theirs: Float) -> Float:
    """Least rotations (T, 3, 3), small ones, that bring stations (T, A, 3) near to others, about their means."""
    a, b = (x - x.mean(axis=1, keepdims=True) for x in (ours, theirs))
    normal = (a**2).sum(axis=(1, 2))[:, None, None] * np.eye(3) - np.swapaxes(a, 1, 2) @ a
    # what no station tells, about the line of two of them, is left as it is
    vector = (np.linalg.pinv(normal, rcond=1e-9, hermitian=True) @ np.cross(a, b).sum(axis=1)[..., None])[..., 0]
    axes = np.broadcast_to(np.eye(3), (len(a), 3, 3))
    turned = axes + np.cross(vector[:, None], axes)  # rows: the images of the unit vectors, to first order
    left, _, right = np.linalg.svd(turned)
    return np.swapaxes(left @ right, 1, 2)


def times_of(slots_s: Float) -> Any:
    """UTC `Time` (T,) of MJD seconds."""
    from astropy.time import Time

    return Time(slots_s // 86400, (slots_s % 86400) / 86400, format="mjd", scale="utc")


def mjd_seconds(times: Any) -> Float:
    """UTC times as MJD seconds (T,), 1 microsecond resolution."""
    utc = times.utc
    return np.atleast_1d((utc.jd1 - 2400000.5) * 86400.0 + utc.jd2 * 86400.0)
