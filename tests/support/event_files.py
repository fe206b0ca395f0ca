"""Event files of cameras, built by hand for tests."""

import base64
import struct
import zlib
from collections.abc import Sequence
from pathlib import Path

import h5py
import numpy as np

from envs.events import EVENT

# Twelve events written by dv-processing 2.0.4 (zlib, base 85): event i has the time
# 1,700,000,000,000,000 us + 100 i^2, x = 37 i mod 346, y = 29 i mod 260, ON when 3 divides i.
LZ4_FILE = (
    "c-oCq&x_MQ6n@!;RZ4dW(nAlr#IcHpwMo~q2W?7ge_+J!f-Sr5DlDOyt%KW4m`n=mNyI-u!9T&Hco#1oy!kJPXOD___a$a)%"
    "|`6NB;O?8_r3RK=3Tnj>fXE7X$@-?b0xo?11JH2y?wh2@yO#^g#w&K1fby5qPGgO@pB2F?oRb76#?U(MK&rXY2<Yrb&tDL_n"
    "Zl}2oI(09de@kj(lVhBUu{>HBC295zTpOOn0Od`eS-*krAKxf(B81qRV3+4FV~cHztj{`?b0eG5;y%f{mHy9QC;y9?>lfpZ4"
    "f;kGJu=aCQZgR4iz?9ZElxS%!2<JsJGRCX#e$FcQp{8HKgOK=O(1I?{>%=sXTrS-{nHF+4kDRHRM2JHtVy!Q9cXtYb6{mO9O"
    "h*a3S&@1KNZo+ORywau(>8M?i{bQ_!IB03(5(W%Yvw07(P20o}}R%%40&Rxp6^$D&U?zE9l?*Dt7D(RP+%@1!7{ve-|CW-bE"
    "U>RFS#V3+*79vG+tyIo0$Kt4=Tn(z1;X)C}i<S=6J8(k-^1O{-IqaH1nmvTCK<Yp~+6dplOC)Gp2*1EvB$NjTbIK<qz#hV@%"
    "2y=3K0w%46eMV4ge6!*LWgVc)PkF{_DxcMfbjd3he_(aVe3{p^(fV1ELnwhEJVfCc__nb5uW|tg<ft2&K1tUx20K)9sZ}*Ur"
    "81UoB"
)
ZSTD_FILE = (
    "c-m7|baV~Ub#V+a(KF!X(qU#`kYHe7@bvd^WdH*%AfJVShk*mgVqgGDGYA0j9cBhN_{PM*V3Sg&P?lO$oSC0zt7N2Spk&9T0"
    "0cI9`6;Oid5O8Hwo3V>C7yX{`AP}}i6t4fO8QW~K2#~Xasv#72FOam$`eaUiWIU_D{YmM^K%P|Qj0<MD=Cyz761(>E-A{)OI"
    "Nas3J!6x(FZBTsXM<YGd(jeF~>JQr8Fni4`@HSA-?%}`OZM`qQvl`%#ze1A`SE}Eh#81!De7;S!!NMF#%&hT3k|#lZ!G7O0f"
    "9MxwN<>KUX0ou_O^JqmU1_PLBvvJyU?zXQpMQ7NHyJ8Ws|a)c~Zp$;1|q2Kt$3(TT<G;>@bl2$+?bc_m7A#wKRitiz%&5=Eb"
    "pnE^5S@=J@7F#_MkG0Za<XmPwDR-fvFyo!`6k@zsSjebg*9Tz11PXl6&t@?iz9^|qxG_i>*P4F%LUX^9`_C>#y?!{|o?SDv|"
    "7CUfs8(+z;n*lsU^KYLJ`7f|hcb(WXOZJTwUh4uhizc_#PEzU@e!`JjCMEfF*#!wZq1nwXr|&YJ*|kZ0PSsSdh_#+-J^TBa#"
    "269`b};j>l{XxGz-J(Fhmoz>`anVfy9CcWhUVqFn0e+^9uF|iX)`qLJw3}G?5YG`CWfFRyb=qxMl%2B4^xo;_uKe&f$hno(t"
    "??Xc5e}RzvU=LL;0;FPA`#VZv#yOQ&!pC`7`Tibs$Tlv^)zNg93xsg3}w<u3<>iWbg+7`sPSO"
)

# The events of `packed_events` as the ECF library of Prophesee packs them in its three ways (zlib, base 85).
ECF_CHUNKS = (
    "c-o6#VqjnpSbF6JkmA>5D5L;<|MmO#Uq(`O$uk%+>}N4zi03q7c*U@aF^fry`4#gjmMm5+wpVPc*t0maIA3wD;>zOI;(5VC4Hf^J"
    "7(@U%)>!5",
    "c-o6(VqjnpSbF6JkmA>5D5L;<|MmO#Uq(`O$uk%+>}N4zi03q7kY<?b6F+70q`mg-%|nwt#V2k`)1*E2ZOvR**bMdz3;+Xym_7",
    "c-o6%VqjnpSbF6JkmA>5D5L;<|MmO#Uq(`Oon~ZUn7Z-`V|)oK^Jh&@_PsBJIomh$aE*%7PkahcJPs)SNyC$U4^X@fD1M58IB^CB"
    "VNReB0|2m8(4z",
)
METAVISION_ROW = np.dtype(
    {"names": list("xypt"), "formats": ["<u2", "<u2", "<i2", "<i8"], "offsets": [0, 2, 4, 8], "itemsize": 16}
)


def some_events(seed: int, count: int, width: int, height: int, until_us: int) -> np.ndarray:
    """Events at random places and times below `until_us`, sorted by time."""
    rng = np.random.default_rng(seed)
    events = np.empty(count, EVENT)
    events["t"] = np.sort(rng.integers(0, until_us, count))
    events["x"], events["y"] = rng.integers(0, width, count), rng.integers(0, height, count)
    events["p"] = rng.choice([-1, 1], count)
    return events


def ecf_chunk(way: int) -> bytes:
    return zlib.decompress(base64.b85decode(ECF_CHUNKS[way]))


def packed_events(way: int) -> np.ndarray:
    """Runs of equal times, rows and polarities beyond what a word of each holds, and a long step."""
    i, events = np.arange(150), np.empty(150, EVENT)
    events["t"] = 10**12 + 7 * np.maximum(0, i - 40) + 900_000 * (i > 100)
    events["x"] = 2 * (i % 50) + 7 if way == 0 else 613 * (i % 8) % 1280
    events["y"] = 29 * (i % 8) if way == 2 else 37 * (i // 50)
    events["p"] = np.where(i < 130, 1, -1)
    return events


def metavision(
    path: Path, chunks: Sequence[bytes], count: int = 150, geometry: str = "1280x720", unpacked: int = 0
) -> Path:
    """A file in the layout of Metavision, of chunks of 150 events that are packed already."""
    with h5py.File(path, "w") as file:
        file.attrs["geometry"], file.attrs["format"] = geometry, "HDF5"
        packing = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        packing.set_chunk((150,))
        packing.set_filter(0x8ECF, h5py.h5z.FLAG_OPTIONAL)
        kind, space = (
            h5py.h5t.py_create(METAVISION_ROW),
            h5py.h5s.create_simple((count,), (h5py.h5s.UNLIMITED,)),
        )
        data = h5py.h5d.create(file.create_group("CD").id, b"events", kind, space, packing)
        for number, chunk in enumerate(chunks):
            data.write_direct_chunk((150 * number,), chunk, unpacked)
    return path


def es(path: Path, events: np.ndarray, width: int, height: int) -> Path:
    """A DVS file of Event Stream, version 2, one event at a time."""
    body, now = bytearray(b"Event Stream" + bytes((2, 0, 0, 1))), 0
    body += struct.pack("<HH", width, height)
    for t, x, y, p in events.tolist():
        turns, rest = divmod(t - now, 127)
        body += b"\xff" * turns + struct.pack("<BHH", rest << 1 | (p > 0), x, height - 1 - y)
        now = t
    path.write_bytes(body)
    return path


def aedat2(path: Path, entries: list[tuple[int, int]], chip: str = "") -> Path:
    lines = b"#!AER-DAT2.0\r\n" + (f"# AEChip: {chip}\r\n".encode() if chip else b"")
    path.write_bytes(lines + b"".join(struct.pack(">II", *entry) for entry in entries))
    return path


def aedat3(
    path: Path, packets: list[tuple[int, int, int, bytes]], sources: str = "#Source 1: DVS128\r\n"
) -> Path:
    """A file of packets: type, turns of the clock, size of an event, bytes."""
    head = f"#!AER-DAT3.1\r\n#Format: RAW\r\n{sources}#!END-HEADER\r\n".encode()
    body = b""
    for kind, turns, size, raw in packets:
        n = len(raw) // size
        body += struct.pack("<hhiiiiii", kind, 1, size, 4, turns, n, n, n) + raw
    path.write_bytes(head + body)
    return path
