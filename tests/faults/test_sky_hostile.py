"""I1, I5, I8, I11 for catalogues: no file is followed, swallowed, waited for or shown; every complaint is one line."""

import gzip
import os
import resource
import threading
from http.server import BaseHTTPRequestHandler, HTTPServer

import numpy as np
import pytest
from astropy import units as u
from astropy.io import fits
from astropy.table import Table

from instrument.errors import FileError
from instrument.sky.forms import read_as
from instrument.sky.points import PointSky

FIELDS = """<FIELD name="ra" datatype="double" unit="deg"/><FIELD name="dec" datatype="double" unit="deg"/>
<FIELD name="i" datatype="double" unit="Jy"/>"""


def told(call, *words):
    with pytest.raises(FileError) as caught:
        call()
    text = str(caught.value)
    assert all(word in text for word in words), text
    assert text.isprintable() and len(text) < 700, text
    return text


def votable(inside, attributes=""):
    return f"""<?xml version="1.0"?><VOTABLE version="1.3" xmlns="http://www.ivoa.net/xml/VOTable/v1.3">
<RESOURCE><TABLE {attributes}>{FIELDS}<DATA>{inside}</DATA></TABLE></RESOURCE></VOTABLE>"""


ROW = "<TABLEDATA><TR><TD>1</TD><TD>2</TD><TD>3</TD></TR></TABLEDATA>"


def test_a_whole_votable_is_read(tmp_path):
    (tmp_path / "t.vot").write_text(votable(ROW, 'nrows="1"'))
    assert PointSky.read(tmp_path / "t.vot").stokes_jy[0, 0] == 3


def test_i1_no_votable_makes_us_open_what_it_names(tmp_path):
    asked = []

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self):
            asked.append(self.path)
            self.send_error(404)

    server = HTTPServer(("127.0.0.1", 0), Handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    (tmp_path / "secret").write_text("1 2 3")
    links = [f"http://127.0.0.1:{server.server_port}/x", f"file://{tmp_path}/secret"]
    try:
        for link in links:
            for data in (
                f'<BINARY><STREAM href="{link}"/></BINARY>',
                f'<FITS extnum="1"><STREAM href="{link}"/></FITS>',
                f'<BINARY2><STREAM HREF="{link}" encoding="gzip"/></BINARY2>',
            ):
                (tmp_path / "t.vot").write_text(votable(data))
                told(
                    lambda: PointSky.read(tmp_path / "t.vot"), "its data lie elsewhere (href), which is never followed"
                )
            (tmp_path / "t.vot").write_bytes(
                votable(f'<BINARY><STREAM href="{link}"/></BINARY>').replace('"1.0"?', '"1.0" encoding="UTF-16"?')
                .encode("utf-16")
            )  # fmt: skip
            told(lambda: PointSky.read(tmp_path / "t.vot"))
    finally:
        server.shutdown()
    assert asked == []


def test_i1_entities_are_not_read(tmp_path):
    text = votable(ROW).replace("<VOTABLE", f'<!DOCTYPE x [<!ENTITY a SYSTEM "file://{tmp_path}/s">]><VOTABLE')
    (tmp_path / "t.vot").write_text(text)
    told(lambda: PointSky.read(tmp_path / "t.vot"), "an entity")


def test_i5_pipes_devices_and_sparse_files_are_told_at_once(tmp_path, monkeypatch):
    os.mkfifo(tmp_path / "pipe.csv")
    told(lambda: PointSky.read(tmp_path / "pipe.csv"), "is a pipe or a device")
    (tmp_path / "zero.csv").symlink_to("/dev/zero")
    told(lambda: PointSky.read(tmp_path / "zero.csv"), "is a pipe or a device")
    with open(tmp_path / "sparse.csv", "wb") as file:
        file.truncate(20_000_000_000)
    told(lambda: PointSky.read(tmp_path / "sparse.csv"), "has 20 GB", "200 MB")
    monkeypatch.setattr("instrument.sky.forms.CATALOGUE_BYTES", 2_000_000)
    (tmp_path / "bomb.csv").write_bytes(gzip.compress(bytes(3_000_000), 1))
    told(lambda: PointSky.read(tmp_path / "bomb.csv"), "unpacked", "2 MB")


def declared(tmp_path, **cards):
    Table({"RA": [1.0] * u.deg, "DEC": [2.0] * u.deg, "I": [3.0] * u.Jy}).write(tmp_path / "t.fits", overwrite=True)
    raw = (tmp_path / "t.fits").read_bytes()
    for card, value in cards.items():
        at = raw.index(f"{card:<8}=".encode(), 2880)
        raw = raw[:at] + f"{card:<8}= {value!s:>20}".encode().ljust(80) + raw[at + 80 :]
    (tmp_path / "t.fits").write_bytes(raw)
    return tmp_path / "t.fits"


def test_i5_what_a_file_declares_is_held_against_its_size_first(tmp_path):
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    told(lambda: PointSky.read(declared(tmp_path, NAXIS2=10**9)), "extension 1 declares 24 GB, the file has")
    told(lambda: PointSky.read(declared(tmp_path, NAXIS1=10**9)), "t.fits")
    for attributes in ('nrows="1000000000"', 'nrows="99999999999999999999"'):
        (tmp_path / "t.vot").write_text(votable(ROW, attributes))
        told(lambda: PointSky.read(tmp_path / "t.vot"), "rows in a file of")
    wide = votable(ROW).replace('name="ra" ', 'name="ra" arraysize="900000000" ')
    (tmp_path / "t.vot").write_text(wide)
    told(lambda: PointSky.read(tmp_path / "t.vot"), "its columns declare 9e+08 numbers")
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 200_000  # kB: nothing was allocated


ECSV = "# %ECSV 1.0\n# ---\n# datatype:\n{}\n# schema: astropy-2.0\nra dec i\n1 2 3\n"
GOOD = "ra_deg,dec_deg,i_jy\n"


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (ECSV.format("# - {unit: deg, datatype: float64}"), ["the ECSV header does not parse"]),
        (ECSV.format("# - ra"), ["the ECSV header does not parse"]),
        ("# %ECSV 1.0\n# ---\n# 5\nra dec i\n1 2 3\n", ["the ECSV header does not parse"]),
        (f"{GOOD}1,2\0,3\n", []),
        (f"{GOOD}1,2,{'9' * 5000}\n", ["i_jy is 999"]),
        (f"{GOOD}1,2,1e400\n", ["i_jy is 1e400, which is not finite"]),
        (f"{GOOD}1,2,1_000\n", ["i_jy = '1_000' is not a number"]),
        (f"{GOOD}1,2,{'x' * 200000}\n", ["line 2"]),
        (f'{GOOD}1,2,"3\n', []),
        ("\n" * 200_000, ["the file is empty"]),
        ("ra_deg,dec_deg,i (" + "m" * 9000 + ")\n1,2,3\n", ["not convertible"]),
        ("ra_deg,dec_deg,i_jy (mJy)\n1,2,3\n", ["no column for i"]),
        ("ra_deg,dec_deg,i [10**99999999 Jy]\n1,2,3\n", ["column 'i [10**99999999 Jy]' is in '10**99999999 Jy'"]),
        ("ra_deg,dec_deg,i [Jy^(-99)]\n1,2,3\n", ["t.csv"]),
        ("ra_deg,dec_deg," + ",".join(f"c{k}" for k in range(5000)) + "\n1\n", ["no column for i"]),
    ],
)
def test_i8_broken_tables_are_one_line(tmp_path, content, words):
    (tmp_path / "t.csv").write_text(content)
    told(lambda: PointSky.read(tmp_path / "t.csv"), *words)


def test_i8_names_that_no_file_can_have_are_one_line(tmp_path):
    told(lambda: PointSky.read("a\0b.csv"), r"a\x00b.csv")
    told(lambda: PointSky.read("x" * 300))
    told(lambda: PointSky.read("x" * 30000 + "/y"))
    told(lambda: PointSky.read("~nobody-of-that-name/x.csv"))
    told(lambda: read_as(PointSky, 5), "is no path of a file")
    told(lambda: PointSky.read(tmp_path), "is a folder")
    (tmp_path / "table.dat").write_text("")
    told(lambda: PointSky.read(tmp_path), "is a CASA table")


SECRET = "root:$6$saltsalt$hAsHhAsHhAsH:19000:0:99999:7:::"


@pytest.mark.parametrize(
    "content",
    [
        f"{SECRET}\ndaemon:*:19000:0:99999:7:::\n",
        "-----BEGIN OPENSSH PRIVATE KEY-----\nhAsHhAsHhAsH\n",
        "API_KEY=hAsHhAsHhAsH\n",
        "hAsHhAsHhAsH\n",
        f"user,{SECRET}\n1,2\n",
    ],
)
def test_i11_contents_of_a_file_that_is_no_sky_are_not_shown(tmp_path, content):
    for name in ("shadow", "x.csv", "x.txt"):
        (tmp_path / name).write_text(content)
        assert "hAsH" not in told(
            lambda name=name: PointSky.read(tmp_path / name), "none of its columns is one that a sky has"
        )
    (tmp_path / "x.skymodel").write_text(content)
    assert "hAsHhAsH" not in told(lambda: PointSky.read(tmp_path / "x.skymodel"))


def test_i11_names_and_contents_do_not_reach_the_terminal_raw(tmp_path):
    (tmp_path / "\x1b[2J.csv").write_text("ra_deg,dec_deg,i_jy\n1,2,\x1b]0;owned\x07\n")
    told(lambda: PointSky.read(tmp_path / "\x1b[2J.csv"), r"\x1b[2J.csv, line 2", r"\x1b]0;owned\x07")
    (tmp_path / "x.skymodel").write_text("FORMAT = Name, Type, Ra, Dec, I\n\x1b[31ma, DISK\x1b[0m, 1deg, 2deg, 1\n")
    told(lambda: PointSky.read(tmp_path / "x.skymodel"), r"DISK\x1b[0m")
    (tmp_path / "x.skymodel").write_text("FORMAT = Name, Type, Ra, Dec, I\n" + "s" * 900 + ", DISK, 1deg, 2deg, x\n")
    assert "sssss" * 20 not in told(lambda: PointSky.read(tmp_path / "x.skymodel"))


def test_i8_arrays_in_a_column_that_is_read_are_told(tmp_path):
    Table({"RA": np.ones((2, 3)) * u.deg, "DEC": [1.0, 2] * u.deg, "I": [1.0, 2] * u.Jy}).write(tmp_path / "t.fits")
    told(lambda: PointSky.read(tmp_path / "t.fits"), "column 'RA' holds arrays")


def test_i8_units_that_take_for_ever_are_told(tmp_path):
    table = Table({"RA": [1.0] * u.deg, "DEC": [1.0] * u.deg, "I": [1.0]})
    hdu = fits.BinTableHDU(table)
    hdu.header["TUNIT3"] = "10**99999999 Jy"
    hdu.writeto(tmp_path / "t.fits")
    told(lambda: PointSky.read(tmp_path / "t.fits"), "'10**99999999 Jy' is no unit that is read")
    (tmp_path / "t.vot").write_text(votable(ROW).replace('unit="Jy"', 'unit="10**99999999 Jy"'))
    told(lambda: PointSky.read(tmp_path / "t.vot"), "'10**99999999 Jy' is no unit that is read")


def test_other_tables_of_a_file_are_named(tmp_path):
    from instrument.errors import unused_ledger

    sky = fits.BinTableHDU(Table({"RA": [1.0] * u.deg, "DEC": [2.0] * u.deg, "I": [3.0] * u.Jy}), name="SKY")
    other = fits.BinTableHDU(Table({"x": [1.0]}), name="NOISE")
    fits.HDUList([fits.PrimaryHDU(), other, sky, fits.ImageHDU(np.ones(3), name="MAP")]).writeto(tmp_path / "t.fits")
    with pytest.warns(match="not used: NOISE, MAP"), unused_ledger() as ledger:
        assert len(PointSky.read(tmp_path / "t.fits")) == 1
    assert ledger == {"t.fits": ["NOISE", "MAP"]}
