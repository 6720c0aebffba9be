"""Jones matrices of LOFAR by EveryBeam, from coordinates to matrices, that `instrument doctor` recomputes.

python docs/reports/doctor_beam.py FILE.ecsv  (extra `peers`; instrument/data/everybeam_lofar.ecsv is its output)
"""

import sys
import tempfile
from importlib import metadata
from pathlib import Path

import numpy as np
from astropy import units as u
from astropy.table import Table

import instrument
from instrument import Observation
from instrument.precision.lofar_ms import make_ms

CENTRE = "08h13m36.0s +48d13m03s"
TELESCOPES = {
    "lofar-hba": (["CS001HBA0", "RS106HBA", "RS508HBA"], [120, 150, 180] * u.MHz),
    "lofar-lba": (["CS302LBA", "RS508LBA"], [30, 60] * u.MHz),
}
DIRECTIONS = [[123.4, 48.2175], [120.0, 51.0], [128.5, 44.5]]  # deg; the first is the centre
TIMES = ["2012-12-06T21:00:00", "2012-12-07T01:20:00"]
COLUMNS = ("xx", "xy", "yx", "yy")


def rows():
    """Every combination, one row each."""
    import everybeam
    from astropy.time import Time

    out = []
    for name, (stations, freq) in TELESCOPES.items():
        telescope = instrument.load("telescopes", name, stations=stations)
        night = Observation(
            phase_centre=CENTRE, transit="2012-12-07", duration=2 * u.min, interval=1 * u.min,
            frequencies=freq[:1], channel_width=0.2 * u.MHz,
        )  # fmt: skip
        with tempfile.TemporaryDirectory() as folder:
            make_ms(Path(folder) / "a.MS", telescope, night)
            theirs = everybeam.load_telescope(str(Path(folder) / "a.MS"), element_response_model="hamaker")
            for time in TIMES:
                mjd_s = Time(time, scale="utc").mjd * 86400
                for k, station in enumerate(stations):
                    for f in freq.to_value("Hz"):
                        for ra, dec in DIRECTIONS:
                            j = theirs.station_response(mjd_s, k, f, np.deg2rad(ra), np.deg2rad(dec)).ravel()
                            parts = {c + p: v for c, z in zip(COLUMNS, j, strict=True)
                                     for p, v in (("_re", z.real), ("_im", z.imag))}  # fmt: skip
                            out.append(
                                {"telescope": name, "station": station, "time": time, "freq_hz": f, "ra_deg": ra}
                                | {"dec_deg": dec} | {c: np.float32(v) for c, v in parts.items()}
                            )  # fmt: skip
    return out


def main():
    """Write the table."""
    table = Table(rows())
    table.meta["made_by"] = (
        f"EveryBeam {metadata.version('everybeam')}, Hamaker's elements, docs/reports/doctor_beam.py"
    )
    table.meta["pointing"] = CENTRE
    table.write(sys.argv[1], format="ascii.ecsv", overwrite=True)


if __name__ == "__main__":
    main()
