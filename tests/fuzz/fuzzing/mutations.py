"""What is done to healthy bytes: flips, cuts, words and numbers changed, lines moved, other encodings, FITS cards."""

import random
import re
import struct

NUMBERS = [
    *(b"nan", b"inf", b"-inf", b"-1", b"0", b"1e308", b"1e400", b"99999999999999999999999", b"-0.0", b"1e-400", b""),
    *(b"x", b"0x1F", b"1,5", b"1_0", "５".encode(), b'"', b"'", b"\x00", b"<b>x</b>", b"=1+1", b"[1", b"1]", b"deg"),
    *(b"1 Jy", b"None", b"true", b"\x1b[31m", b"\x1b]0;x\x07"),
]
WORDS = re.compile(rb'(\s+|[,=\[\]{}<>"])')
NUMBER = re.compile(rb"(?<![\w.])[-+]?\d+\.?\d*(?:e[-+]?\d+)?")


def flipped(rng: random.Random, content: bytes, count: int = 0) -> bytes:
    """Some bits, bytes or short runs changed, taken out or put in."""
    out = bytearray(content)
    for _ in range(count or rng.choice([1, 1, 2, 4, 16])):
        k, how = rng.randrange(len(out)), rng.randrange(4)
        if how == 0:
            out[k] ^= 1 << rng.randrange(8)
        elif how == 1:
            out[k] = rng.randrange(256)
        elif how == 2:
            del out[k : k + rng.randrange(1, 9)]
        else:
            out[k:k] = rng.randbytes(rng.randrange(1, 5))
        out = out or bytearray(b"x")
    return bytes(out)


def cut(rng: random.Random, content: bytes) -> bytes:
    """The beginning only."""
    return content[: rng.randrange(len(content))]


def words(rng: random.Random, content: bytes) -> bytes:
    """Words replaced, swapped, repeated or left out."""
    parts = WORDS.split(content)
    places = [k for k, part in enumerate(parts) if part.strip()]
    for _ in range(rng.choice([1, 1, 2, 3])):
        k, how = rng.choice(places), rng.randrange(4)
        if how == 0:
            parts[k] = rng.choice(NUMBERS)
        elif how == 1:
            j = rng.choice(places)
            parts[k], parts[j] = parts[j], parts[k]
        else:
            parts[k] = parts[k] * rng.choice([2, 50]) if how == 2 else b""
    return b"".join(parts)


def lines(rng: random.Random, content: bytes) -> bytes:
    """A line taken out, repeated or made longer, or all shuffled."""
    rows = content.split(b"\n")
    k, how = rng.randrange(len(rows)), rng.randrange(4)
    if how == 0:
        del rows[k]
    elif how == 1:
        rows.insert(k, rng.choice(rows))
    elif how == 2:
        rng.shuffle(rows)
    else:
        rows[k] = rows[k] * rng.choice([2, 3])
    return b"\n".join(rows)


def number(rng: random.Random, content: bytes) -> bytes:
    """One number in the text replaced."""
    found = rng.choice(list(NUMBER.finditer(content)))
    return content[: found.start()] + rng.choice(NUMBERS[:16]) + content[found.end() :]


def encoded(rng: random.Random, content: bytes) -> bytes:
    """The text in another encoding, with other line ends, or with zero bytes."""
    text = content.decode("utf-8", "replace")
    made = (
        lambda: text.encode("utf-16"),
        lambda: text.encode("utf-32"),
        lambda: b"\xef\xbb\xbf" + content,
        lambda: text.replace("fuzz", "caf\xe9").encode("latin-1", "replace"),
        lambda: text.replace("\n", "\r\n").encode(),
        lambda: text.replace("\n", "\r").encode(),
        lambda: content.replace(b"e", b"\xe9"),
        lambda: content + b"\x00" * 100,
        lambda: b"\x00" + content,
    )
    return rng.choice(made)()


def text(rng: random.Random, content: bytes) -> bytes:
    """Any of the above."""
    return rng.choice([flipped, cut, words, words, lines, encoded, number])(rng, content)


CARD_VALUES = [
    *(b"1000000000", b"-1", b"0", b"NaN", b"'x'", b"T", b"1E400", b"1E308", b"", b"99999999999999999999", b"-32"),
    *(b"8", b"3", b"1.5", b"180.0", b"1E300"),
]
CARDS = [
    *(f"NAXIS{k}".encode() for k in ("", 1, 2, 3, 4)),
    *(f"{key}{k}".encode() for key in ("CDELT", "CRVAL", "CRPIX", "CTYPE", "CUNIT") for k in (1, 2, 3, 4)),
    *(b"BITPIX", b"BUNIT", b"BMAJ", b"BMIN", b"BPA", b"SIMPLE", b"TFIELDS", b"PCOUNT", b"GCOUNT", b"TFORM1", b"TFORM2"),
    *(b"TTYPE1", b"TTYPE2", b"XTENSION", b"TUNIT1", b"END", b"EXTEND"),
]
NEW_CARDS = [
    *(b"BSCALE  = 1E308", b"BZERO   = NaN", b"BLANK   = 0", b"PV1_1   = 1E300", b"CROTA2  = 45.0", b"PC1_2   = 0.5"),
    *(b"CD1_1   = 0.0", b"LONPOLE = 1E400", b"RADESYS = 'FK9'", b"EQUINOX = -1E9", b"ZIMAGE  = T", b"BSCALE  = 0"),
    *(b"ZNAXIS1 = 1000000000", b"CASAMBM = T", b"EPOCH   = 1950.0", b"BMAJ1   = 0.05"),
]


def fits(rng: random.Random, content: bytes) -> bytes:
    """A FITS file with bytes flipped, cut off, or with cards changed, added or blanked."""
    how = rng.randrange(7)
    if how == 0:
        return flipped(rng, content)
    if how == 1:
        return cut(rng, content)
    out = bytearray(content)
    if how == 2:
        out[rng.randrange(2880)] = rng.randrange(256)
    elif how < 6:
        for _ in range(rng.choice([1, 1, 2])):
            _set_card(rng, out, rng.choice(CARDS), rng.choice(CARD_VALUES))
    elif rng.random() < 0.6:
        place = _card(rng, out, b"END")
        if place is not None:
            out[place : place + 160] = rng.choice(NEW_CARDS).ljust(80) + b"END".ljust(80)
    elif (place := _card(rng, out, rng.choice(CARDS))) is not None:
        out[place : place + 80] = b" " * 80
    return bytes(out)


def pixels(rng: random.Random, content: bytes) -> bytes:
    """Values of a float32 image that no sky has."""
    out = bytearray(content)
    for _ in range(rng.choice([1, 50, 5000])):
        place = 2880 + 4 * rng.randrange(8 * 4 * 256)
        value = rng.choice([float("nan"), float("inf"), 3e38, -3e38, 1e-44, 0.0])
        out[place : place + 4] = struct.pack(">f", value)
    return bytes(out)


def _card(rng: random.Random, content: bytearray, key: bytes) -> int | None:
    found = [k for k in range(0, len(content) - 80, 80) if bytes(content[k : k + 8]).rstrip() == key]
    return rng.choice(found) if found else None


def _set_card(rng: random.Random, content: bytearray, key: bytes, value: bytes) -> None:
    place = _card(rng, content, key)
    if place is not None:
        written = value.ljust(20) if value.startswith(b"'") else value.rjust(20)
        content[place + 8 : place + 80] = (b"= " + written).ljust(72)[:72]
