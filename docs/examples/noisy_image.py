"""A polarized sky with rotation measures, thermal noise, and an image in four Stokes parameters."""

import numpy as np
from astropy import units as u
from astropy.coordinates import SkyCoord

import instrument
from instrument import Imager, Observation, PointSky, Scene

centre = SkyCoord("08h13m36.0s +48d13m03s")
places = centre.directional_offset_by([30, 150, 270] * u.deg, [0.8, 0.6, 1.0] * u.deg)
sky = PointSky.at(
    places,
    [[3.0, 0.6, 0.0, 0.0], [2.0, 0.0, 0.5, 0.0], [4.0, 0.0, 0.0, 0.4]],  # I, Q, U, V in Jy
    frequency=150 * u.MHz,
    rotation_measure=[2.0, -1.0, 0.0],  # rad/m^2
    names=["Q", "U", "V"],
)
# without a beam; the six stations of the superterp and six more of the core
core = [f"CS{n:03}HBA{k}" for n in (2, 3, 4, 5, 6, 7) for k in (0, 1)]
bare = instrument.load("telescopes", "lofar-hba", stations=core, beam=None)
night = Observation(
    phase_centre=centre,
    transit="2012-12-07",
    duration=6 * u.hour,
    interval=2 * u.min,
    frequencies=[150, 152] * u.MHz,
    channel_width=0.2 * u.MHz,
)
vis = Scene(instrument=bare, sky=sky, observation=night).plan().run()
noisy = vis.with_noise(sefd=2820 * u.Jy, seed=3)
imager = Imager(pixels=256, pixel=1 * u.arcmin, uv_range=(10, 200))
cube, clean = imager.image(noisy), imager.image(vis)

fwhm = 60 * np.rad2deg(cube.psf.major_rad[0])
print(f"cube {cube.data.shape} in {cube.unit}, PSF {fwhm:.1f} arcmin, bandwidth {vis.width_hz / 1e6} MHz")
length = np.hypot(*vis.uvw_m[..., :2].T) * 150e6 / 299792458.0
count = np.count_nonzero((length >= 10) & (length <= 200))  # visibilities in the image; I averages pp and qq
expected, found = vis.noise_jy(2820 * u.Jy) / np.sqrt(2 * count), (cube.data - clean.data)[0].std()
print(f"noise {1e3 * found:.2f} mJy/beam, expected {1e3 * expected:.2f}")
for name, place, wanted in zip(sky.names, places, sky.stokes(cube.freq_hz)[1], strict=True):
    x, y = (int(np.rint(v)) for v in cube.wcs.celestial.world_to_pixel(place))
    found = " ".join(f"{v:+.2f}" for v in cube.data[1, :, y, x])
    print(f"{name} at pixel ({x}, {y}), 152 MHz: {found} Jy/beam; true {' '.join(f'{v:+.2f}' for v in wanted)} Jy")
print("(dirty images: the sidelobes of the others are still in them)")
