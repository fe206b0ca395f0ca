"""Event files of cameras, built by hand for tests."""

import struct
from pathlib import Path

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


def aedat2(path: Path, entries: list[tuple[int, int]], chip: str = "") -> Path:
    lines = b"#!AER-DAT2.0\r\n" + (f"# AEChip: {chip}\r\n".encode() if chip else b"")
    path.write_bytes(lines + b"".join(struct.pack(">II", *entry) for entry in entries))
    return path
