"""Builders of glTF files after the specification, independent of the program's own writer."""

from __future__ import annotations

import base64
import json
import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from progdf.gaussians import Gaussians
from tests.helpers.scenes import random_gaussians

EXTENSION = "KHR_gaussian_splatting"
LOOK = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
_TYPES = {"f4": 5126, "u1": 5121, "i1": 5120, "u2": 5123, "i2": 5122, "u4": 5125}
_KINDS = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}


class GltfBuilder:
    """Tables and one buffer of a file under construction."""

    def __init__(self) -> None:
        self.data = bytearray()
        self.tables: dict[str, Any] = {
            "asset": {"version": "2.0"},
            "extensionsUsed": [EXTENSION],
            "meshes": [],
            "accessors": [],
            "bufferViews": [],
        }

    def view(self, content: bytes) -> int:
        """Add a buffer view."""
        self.data += b"\0" * (-len(self.data) % 4)
        place = {"buffer": 0, "byteOffset": len(self.data), "byteLength": len(content)}
        self.tables["bufferViews"].append(place)
        self.data += content
        return len(self.tables["bufferViews"]) - 1

    def accessor(self, values: np.ndarray, **more: Any) -> int:
        """Add an accessor for rows of numbers. [N,size]"""
        entry = {
            "bufferView": self.view(np.ascontiguousarray(values).tobytes()),
            "componentType": _TYPES[values.dtype.str[1:]],
            "count": len(values),
            "type": _KINDS[values.shape[1]],
        }
        self.tables["accessors"].append(entry | more)
        return len(self.tables["accessors"]) - 1

    def attributes(self, scene: Gaussians) -> dict[str, int]:
        """Add the columns of a scene, in its own axes."""
        columns = {
            "POSITION": scene.means,
            f"{EXTENSION}:ROTATION": scene.unit_quats[:, [1, 2, 3, 0]],
            f"{EXTENSION}:SCALE": scene.scales,
            f"{EXTENSION}:OPACITY": scene.opacities[:, None],
        }
        coefficients = scene.sh
        for degree in range(scene.sh_degree + 1):
            for i in range(2 * degree + 1):
                columns[f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{i}"] = coefficients[:, degree**2 + i]
        return {name: self.accessor(values.numpy().astype("<f4")) for name, values in columns.items()}

    def primitive(self, attributes: dict[str, int], **look: Any) -> dict[str, Any]:
        """Return a primitive of Gaussians."""
        return {"attributes": attributes, "mode": 0, "extensions": {EXTENSION: LOOK | look}}

    def mesh(self, *primitives: dict[str, Any]) -> int:
        """Add a mesh."""
        self.tables["meshes"].append({"primitives": list(primitives)})
        return len(self.tables["meshes"]) - 1

    def nodes(self, *nodes: dict[str, Any], roots: tuple[int, ...] = (0,)) -> None:
        """Set the nodes, and the roots of the scene."""
        self.tables |= {"scene": 0, "scenes": [{"nodes": list(roots)}], "nodes": list(nodes)}

    def write(self, path: Path, uri: str | None = None) -> Path:
        """Write a .glb, or a .gltf whose buffer has the given name."""
        buffer: dict[str, Any] = {"byteLength": len(self.data)}
        if uri is not None:
            buffer["uri"] = uri
        text = json.dumps(self.tables | {"buffers": [buffer]}).encode()
        if path.suffix == ".gltf":
            path.write_bytes(text)
            return path
        text += b" " * (-len(text) % 4)
        data = b"" if uri is not None else bytes(self.data) + b"\0" * (-len(self.data) % 4)
        chunks = struct.pack("<II", len(text), 0x4E4F534A) + text
        if data:
            chunks += struct.pack("<II", len(data), 0x004E4942) + data
        path.write_bytes(b"glTF" + struct.pack("<II", 2, 12 + len(chunks)) + chunks)
        return path

    def data_uri(self) -> str:
        """Return the buffer as a data: URI."""
        return "data:application/octet-stream;base64," + base64.b64encode(self.data).decode()


def one_mesh(scene: Gaussians, node: dict[str, Any] | None = None, **look: Any) -> GltfBuilder:
    """Return a file with one mesh in one node."""
    builder = GltfBuilder()
    mesh = builder.mesh(builder.primitive(builder.attributes(scene), **look))
    builder.nodes({"mesh": mesh} | (node or {}))
    return builder


def gltf_with_everything() -> GltfBuilder:
    """Return a file with nested nodes, instances, sparse rows, indices and linear colors."""
    builder = GltfBuilder()
    attributes = builder.attributes(random_gaussians(12, seed=1, sh_degree=1))
    rows = {"bufferView": builder.view(np.array([2, 7], "<u2").tobytes()), "componentType": 5123}
    values = {"bufferView": builder.view(np.ones((2, 3), "<f4").tobytes())}
    colors = builder.tables["accessors"][attributes[f"{EXTENSION}:SH_DEGREE_0_COEF_0"]]
    colors["sparse"] = {"count": 2, "indices": rows, "values": values}
    linear = builder.primitive(attributes, colorSpace="lin_rec709_display")
    indexed = builder.primitive(attributes)
    indexed["indices"] = builder.accessor(np.array([[3], [1]], "<u4"))
    mesh = builder.mesh(linear, indexed)
    half = [0.5, 0.5, 0.5, 0.5]
    builder.nodes(
        {"children": [1, 2], "rotation": half, "scale": [2, 2, 2], "name": "root"},
        {"mesh": mesh, "matrix": [0, 1, 0, 0, -1, 0, 0, 0, 0, 0, 1, 0, 1, 2, 3, 1]},
        {"mesh": mesh, "translation": [1, 0, 0], "extensions": {"KHR_node_visibility": {"visible": True}}},
    )
    return builder


def splat_transform_glb(version: str) -> bytes:
    """Return splat-transform's conversion of the three Gaussians in `SPLAT_TRANSFORM_ROWS`."""
    return zlib.decompress(base64.b85decode("".join(_SPLAT_TRANSFORM[version])))


SPLAT_TRANSFORM_ROWS = (
    (
        -0.52, 0.09, -0.26, 0.21, 0.25, -0.87, -0.97, 0.67, -0.48, -0.53, 0.99, -0.06,
        0.67, -0.05, 0.28, -1.0, -3.0, -2.5, -3.5, 1, 0, 0, 0,
    ),
    (
        -0.7, 0.27, 0.74, 0.05, 0.48, 0.34, -0.87, 0.52, 0.18, -0.4, -0.94, 0.73,
        -0.05, 0.44, 0.76, -0.5, -2.75, -2.5, -3.75, 0.8, 0.6, 0, 0,
    ),
    (
        0.43, 0.84, -0.21, 0.6, -0.11, 0.87, 0.76, -0.81, -0.73, -0.57, 0.93, -0.13,
        0.25, -0.4, 0.01, 0.0, -2.5, -2.5, -4.0, 0.5, -0.5, 0.5, 0.5,
    ),
)  # fmt: skip
"""Columns: x y z, f_dc 3, f_rest 9 (by channel), opacity, scale 3, rot 4, as in the converted .ply."""

_SPLAT_TRANSFORM = {
    "1.10.1": (
        "c-pO2O>7fK6yCO~TDVopr59=q7f_A0JF~wQ-mNi)qzzf(7^;e-X0sWarQV<Jtka~HrASo{?Iq#{94WU-k=j!(@d9T!bLoY1b",
        "8XLkvvvrCSXgmZdfIt!zVDmAH~Y5Lu3!035QO`u1Yz-0LHK&Xp6eoqF`A%a7p>Bmd0~Kx2p2?@M=cuA*h#_|A}ne<$%Q0#0@",
        "e&;KPMF=u^^#d9?`Xg2As!kFuH<@x6n7!wMNV7Fy=WyBO@kW&_YXj#9WX>MRC|-fbOCoT*+GEQV$^eUKjb4-2p5QE_a$um|P",
        "ZKUQg&O4O$6wVqHJzzUk4QhLFt9#^GqY+00frboa?b&7;JLTfB?NhKhUnkyMU-lPlrzxw8H?m;2*#4fXhQmIyxnq$OFNU}Sx",
        "Qt;W&>YsLzG9~tt+ab3z-7{8e<JbRAH7&r8zFrYzFUymSl6$z_6*a^5GXlGG$vsxi=V|)*8&#en$K{c{R*G0_`H7PF^L_^FT",
        "qG&4Cbk)cM3@ZbiD60f3sxHIid}obchJs861Wi(~qG&Q`=p;jHMAL|&s02cqJU|%=Q8k(1rGw2GtVkMTMbgnLk`cd-vG26Kp",
        "ZU#B;toA5kB`4$GCC|qCfWVNV)8M?7Aoc0a_t>C<s|2(o}`#|l4ANqVmy7}t3CXHN3rL7iMKj*p$x>{awp+#7hSg(X6iHcTs",
        "B6<p0#TYG0WDYt4FbB*UJMu9*N;cSIuTM0$^V+S7z$pWyvv0W4dv<dbL)qHpE87u3q7@QpP|_uhHuGXem3ranTr#2MVqa6*A",
        "kkgUZV{bVSvKo*!r&&^8<rZMVIMQN+)$9mWfh<MOj(acj8|Q&$s>#)`+O>i~i8BNw<vlRF_?e&jkn{0&_8SmFdO*NEcqE_IW",
        "^A43G?IpW?bMZI1RN_j7r%Y7gSmuBXKoiiV&d-FS`oim$#LP+{!={NInRI>g%_qSO({jCMo-?~?>{_^Pl?LXG~8^T-9hV}5l",
        "=hnXW;`uCZr(o8Bef2~Ta$vW?#9=!czPW8Y`SY(|&5y1<H8~!}gZGA6+xb2Pz0%gRf6eaHw#moYzWQnx;?~~$S~|7;N&3a+m",
        "(~FHybsvj#jQ)$=0BgMoX`6nM?H(jVU5<y-=h@x=J`cC?M?+2=YTd?XZQT#mbo{to71m~7T17x3Y`AwmuD~j4<1|@{r",
    ),
    "2.3.1": (
        "c-pO2O>7%Q6kb3G=nW|sE+rarAi}kFXZF{^UR>900%<mNOc82=yK%<ug7=5rbx5!*SwcC0ge-1_BlLz82~IhXb?G@h_tHymN",
        "c2k2eQ)hHCB(vtv(jkxz4^Xx-pst&x6M}d^2>rC+<rq4)?OEc4_B?_4zZ(%$0XMwTRe;$-y=Cfvm(imCii$~$9@Q&C}`R7g*",
        "ddmsNsk1EX}g4M7kNmw`1-hE&4d(n<RIGe6&!hHSKm3Iks0zd9mX)$$ExFbx<TZar71ex<fpFGkp`+y8wA+b%@KOTYyF9M!V",
        "5~*i!e#PRy6M*NkD1>iW^}b%%d7f~0mj52CF`BVFLgd`4z!hQxN*#33ddD(z;*QW5(iSE7@1W&Ph=v?t{n>gi*a7(IQ^k}OX",
        "#vp&UEQ)!AdQ-%H?8S=%h*Lf8A;fvXV*>h6H)O|PbJ?_QTod8l-k*JE!wugeCoqEaja*4r(aUHlkH!g@-nThG6NeWdIP0oN%",
        "X9hkR(==u%DnlPtQlBBpDx-?3%MhJwZ{uyqs>2~&7c~Qf5H1=+S*B<z)pXU!h*?b@`V57sn#}0>(e@12Bu%g;>Et!Z1TSRh+",
        "AZg6yxVcu=Evpf>9<TK$Hmw*`+r<aKBd@dskl_E{6|hX%h=Sj6w}U9OrJ^&^B2C`qfdAcI<6BtTO$(+LFjC>V>CNt#admgE?",
        "Ud!93^YXs?@|ZTTiYZxr$XS4)Js>29K_sMl}XttrSa()lbvp7^ksNyHvhXDVJ+vtz?xiV^qonXz4jxog6Ktr#C5@!tp@Kb)i",
        "P4yLME2aYM({T^RX-haPXiA@Nqr2_jDL{91mv8rXF_yC`gK)Iwg@M5DIpAaw^I@P$Nyt31Bt!{sM++lAkOOHLHqUL7@p(Eps",
        "*<KZtu00lZgYm1X^w+qF*J3IT5AY5Er7WU7-YCgWUf3SakH(`vKU*^9{?gV-B$-57e{JBpC(31WS#qu{l-@f_lcG44`KRuI5",
        "-_O18&CmVx<6Gwa!zFX&FMAFK2BT&U`w#94!Ys6#(8SSuFzT`O?*8`sw}n@({#if{%m;n1P}%=%0Gj#!y?+XwnY{wev3KRs0",
        "r(-_ZF6StHS_J=_XcR+KRhfTcCCMLu>1F$FmEq`G4oE)#kdY|jSqea2EZ@OuUUi6jE9^Awfpzl`T4be^7xvbEIi5$Py>1sIE",
        "8Z$-udGxRq-Cv",
    ),
    "2.7.1": (
        "c-pO2O>7%Q6kb3TkQ-7iNT@_Z4n(-t?(Dx6d*!-rlQzw!jwz~|)ZI8^cftF^?mA7dECo=IKtdK5R1hcVp%PLgIORar&~tk3r",
        "I+52NRPmk_ttJxLM*H}E3IbVoA3MP&CHv5TW^%lzsPaiomV+-=@pK<xM<F|h!ut`BAFIhV?k(pF3Av@=1Gdwnactz@&fRLe#",
        "45+M1kdoH7{@`Xj)ARq@5ycJz_4>!goWqN;22UrI}KtZZ*Tuw%kg>i)^<}mQy6Gf+ETA{jU(vE#i8s$rr!e2FO#ZMI0910xU",
        "XLnzb6lmbh0oA~wg|dIX(R(+;|?+U#~8lGw>Oh&F4rWP*M3DOprfB(j1!c8QX%&~|Dd6|v8A1v)%e(*Dgwdswcn96x43q{k0",
        "hkfaet)<#%rDvU5^D%1ZXL%vwmDhop|cs^S&dydMOs^|Eg%iO5E;X~@m0#(r2bWsqr6EC@1EQoMm92*YL^)q~068Yp&1)0jS",
        "Dy6`ui8?;2sH&naD<b-+ocMHJQbZ~%ngr1~);gYsw9@O+G+xy~2;scmlNDuEp{l0nDL$=AJ)bU%iYke8`Cxf^a}tJ_lW_E$B",
        "!UMraIA*?5uWWRXtKld^!Q6Ak;7u*DC>V%Ogg66Vj(}5Fa1YOKFQdWlN3`=QcN334D%Q6?fw<+2exBJ_FCVBLJ-(1%?QmFSu",
        "hu8%d_TuGDg9iGfNdd$=0LmN2X+!^F2Hrh{3HZCQ%Ilm<##BZ24M}9D_7wD(8w9O2uM@uN2JUd5lUP0xdj4E5oCOWcP+eQ`j",
        "CTxenCGWYrF8FD~eSx(huYu)t*v*d*3y*nY?e?q9<T7JaLVdlv@vl}f;>Dz8^oZKQ4h1a3$axXhwk9vpsBwH){zIA@2E<yKL",
        "{54`tTHR}B`_)wsIwAL7Dx7$$6+Y=KnaNOD1d2Z+QDP#Z2&hF0XtymOA<HPJ1@m)V_{Pp&uI6L-U7v8w@RlfM?_jhjoxE^nE",
        "&z?<#3SUl6yHk_je)GEVU~kS?_}!X>j&A=ou>I`GrEL0*d)bd~{yqKO{wK-z#e2U_V~g+h*w@oP{rq|ErOUtNkOSjEyO}HP+",
        "~|U4wsZf_Tx)zghhuDCc)SaKh<Du>-+tM6bL*Wh+7I^ja)@2(ob7J?@fwV~8AG3O*KcE7yEw;(KlokX=cbm-Zfo2{PK?@}`_",
        "1gsQYYTOqQx_hGhNhx)&Nd!?BQF#`~zTMBw+",
    ),
}
