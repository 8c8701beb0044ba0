"""USD writer for Gaussians (UsdVol.ParticleField3DGaussianSplat), as a still or as an edit over time.

Values are activated: linear scales, opacities 0 to 1. The y axis points up and z towards the viewer.
Attributes that do not change are stored once. Every sample has the same rows, including invisible ones.
"""

from __future__ import annotations

import errno
import importlib.util
import os
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from progdf.errors import ProgdfError
from progdf.gaussians import Gaussians
from progdf.system.packages import install_extra

SUFFIX = ".usdc"
_PATH = "/Gaussians"


def write_usd(path: Path, scenes: Iterable[Gaussians], rate: float = 24.0) -> None:
    """Write one scene, or several scenes as the samples 0, 1, … of one prim.

    Args:
        path: the file, which is overwritten; ends in .usdc
        scenes: N Gaussians each, with y up and the same rows in all scenes
        rate: samples per second

    Raises:
        ProgdfError: the package usd-core is not installed.
        OSError: the file cannot be written.
    """
    if importlib.util.find_spec("pxr") is None:
        raise ProgdfError(f".usdc needs the package usd-core; {install_extra('usd')}")
    from pxr import Tf

    try:
        _write_stage(path, scenes, rate)
    except Tf.ErrorException as error:
        raise _system_error(str(error)) from None


def _system_error(message: str) -> OSError:
    """Return the system error behind an error of the USD library, which only keeps its text."""
    for code in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EACCES, errno.EROFS, errno.ENOENT):
        if os.strerror(code) in message:
            return OSError(code, os.strerror(code))
    return OSError(errno.EIO, f"the USD library reports {' '.join(message.split()):.200}")


def _write_stage(path: Path, scenes: Iterable[Gaussians], rate: float) -> None:
    """Write the scenes; see `write_usd`."""
    from pxr import Gf, Usd, UsdGeom, UsdVol, Vt

    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)  # the default is centimeters: Blender would shrink it 100×
    stage.SetTimeCodesPerSecond(rate)
    prim = UsdVol.ParticleField3DGaussianSplat.Define(stage, _PATH)
    stage.SetDefaultPrim(prim.GetPrim())
    create = {
        "positions": (prim.CreatePositionsAttr(), Vt.Vec3fArray),
        "orientations": (prim.CreateOrientationsAttr(), Vt.QuatfArray),
        "scales": (prim.CreateScalesAttr(), Vt.Vec3fArray),
        "opacities": (prim.CreateOpacitiesAttr(), Vt.FloatArray),
        "coefficients": (prim.CreateRadianceSphericalHarmonicsCoefficientsAttr(), Vt.Vec3fArray),
    }
    previous: dict[str, NDArray[np.float32]] = {}
    for time, scene in enumerate(scenes):
        for name, values in drawn_values(scene).items():
            attribute, kind = create[name]
            if time and np.array_equal(values, previous[name]):
                continue
            if time and attribute.GetNumTimeSamples() == 0:  # constant until now
                attribute.Clear()
                attribute.Set(kind.FromNumpy(previous[name]), 0)
            if time and attribute.GetNumTimeSamples() and attribute.GetTimeSamples()[-1] != time - 1:
                attribute.Set(kind.FromNumpy(previous[name]), time - 1)
            if time:
                attribute.Set(kind.FromNumpy(values), time)
            else:
                attribute.Set(kind.FromNumpy(values))
            previous[name] = values
        if time == 0:
            prim.CreateRadianceSphericalHarmonicsDegreeAttr(scene.sh_degree)
            UsdGeom.Primvar(prim.GetRadianceSphericalHarmonicsCoefficientsAttr()).SetElementSize(
                1 + scene.shN.shape[1]
            )
            extent = scene.means.amin(dim=0).tolist(), scene.means.amax(dim=0).tolist()
            prim.CreateExtentAttr(Vt.Vec3fArray([Gf.Vec3f(*corner) for corner in extent]))
            if any(scene.origin):
                prim.AddTranslateOp().Set(Gf.Vec3d(*scene.origin))
        stage.SetEndTimeCode(time)
    stage.SetStartTimeCode(0)
    stage.GetRootLayer().Save()


def drawn_values(scene: Gaussians) -> dict[str, NDArray[np.float32]]:
    """Return the stored attributes of a scene: positions, orientations (xyzw), scales, opacities and SH."""
    columns = {
        "positions": scene.means,
        "orientations": scene.unit_quats[:, [1, 2, 3, 0]],
        "scales": scene.scales,
        "opacities": scene.opacities,
        "coefficients": scene.sh.reshape(-1, 3),
    }
    return {name: np.ascontiguousarray(t.detach().cpu().float().numpy()) for name, t in columns.items()}
