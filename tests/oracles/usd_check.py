#!/usr/bin/env python3
"""OpenUSD's reading of files that Centaur writes, and OpenUSD files for Centaur to read. Called by
tests/integration/usd_oracle.rs.

    usd_check.py check FILE EXPECTED.json     # opens FILE, compares values, runs ComplianceChecker and VG.035
    usd_check.py write FILE SPLATS.json       # writes splats below moved prims, prints where they are as JSON
Exit code 1 and a line per fault if something is wrong. Written with usd-core 26.3 and usd-validation-nvidia 1.22.0.
"""
import io
import json
import pathlib
import subprocess
import sys

import numpy as np
from PIL import Image
from pxr import Ar, Gf, Sdf, Usd, UsdGeom, UsdShade, UsdUtils, UsdVol, Vt

faults = []


def check(what, holds):
    if not holds:
        faults.append(what)


def same(what, found, expected, tolerance=0.0):
    # JSON has enough digits to restore a 32-bit float.
    found, expected = (np.array(v, np.float32).astype(np.float64).ravel() for v in (found, expected))
    check(f"{what}: {found.size} values for {expected.size}", found.size == expected.size)
    if found.size == expected.size:
        worst = np.abs(found - expected).max(initial=0.0)
        check(f"{what}: differs by {worst}", worst <= tolerance)


def vg035(file):
    """Findings of NVIDIA's rules for splats."""
    tool = pathlib.Path(sys.executable).parent / "nvidia_usd_validate"
    report = pathlib.Path(file).with_suffix(".vg035.json")
    run = subprocess.run(
        [tool, "--no-init-rules", "--requirement", "com.nvidia.usd.VG.035", "--json-output", report, file],
        capture_output=True, text=True)
    check(f"VG.035 did not run: {run.stderr}", report.exists())
    rules = json.loads(report.read_text())["rules"] if report.exists() else []
    return [issue["message"] for rule in rules for issue in rule["issues"]]


def splats(stage, expected):
    prim = stage.GetPrimAtPath("/Scene/splats")
    schema = UsdVol.ParticleField3DGaussianSplat(prim)
    check("/Scene/splats is no ParticleField3DGaussianSplat", bool(schema))
    same("positions", schema.GetPositionsAttr().Get(), expected["positions"])
    quaternions = [[q.real, *q.imaginary] for q in schema.GetOrientationsAttr().Get()]
    same("orientations", quaternions, expected["orientations"])
    same("scales", schema.GetScalesAttr().Get(), expected["scales"])
    same("opacities", schema.GetOpacitiesAttr().Get(), expected["opacities"])
    coefficients = schema.GetRadianceSphericalHarmonicsCoefficientsAttr()
    same("coefficients", coefficients.Get(), expected["coefficients"])
    check("degree", schema.GetRadianceSphericalHarmonicsDegreeAttr().Get() == expected["degree"])
    check("elementSize", coefficients.GetMetadata("elementSize") == (expected["degree"] + 1) ** 2)
    check("sortingModeHint", schema.GetSortingModeHintAttr().Get() == "zDepth")
    check("ColorSpaceAPI", Gf.ColorSpace.IsValid(prim.GetAttribute("colorSpace:name").Get()))
    low, high = (np.array(v, np.float64) for v in schema.GetExtentAttr().Get())
    means = np.array(expected["positions"])
    check("the extent holds all means", (low <= means).all() and (means <= high).all())
    return prim


def known(prim):
    """Checks that every attribute is in the schema with the required type, or custom."""
    definition = prim.GetPrimDefinition()
    for attribute in prim.GetAuthoredAttributes():
        name = attribute.GetName()
        if attribute.IsCustom() or name.startswith(("primvars:", "inputs:", "outputs:", "xformOp:")):
            continue
        check(f"{prim.GetPath()}.{name} is in no schema", name in definition.GetPropertyNames())
        declared = definition.GetAttributeDefinition(name)
        if declared:
            check(f"{prim.GetPath()}.{name} has type {attribute.GetTypeName()}", declared.GetTypeName() == attribute.GetTypeName())


def meshes(stage, expected):
    for i, mesh in enumerate(expected):
        prim = stage.GetPrimAtPath(f"/Scene/mesh_{i}")
        geometry = UsdGeom.Mesh(prim)
        same("points", geometry.GetPointsAttr().Get(), mesh["points"])
        same("indices", geometry.GetFaceVertexIndicesAttr().Get(), mesh["indices"])
        st = UsdGeom.PrimvarsAPI(prim).GetPrimvar("st")
        check("st is per corner", st.GetInterpolation() == "faceVarying" and st.GetTypeName() == "texCoord2f[]")
        same("st", st.ComputeFlattened(), mesh["st"])
        material, _ = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()
        shader, _, _ = material.ComputeSurfaceSource()
        check("UsdPreviewSurface", shader.GetIdAttr().Get() == "UsdPreviewSurface")
        for name, space, mode in [("emissiveColor", "sRGB", "RGB"), ("opacity", "raw", "L")]:
            source = shader.GetInput(name).GetConnectedSources()[0][0].source
            texture = UsdShade.Shader(source.GetPrim())
            check(f"{name}: colour space", texture.GetInput("sourceColorSpace").Get() == space)
            path = texture.GetInput("file").Get()
            asset = Ar.GetResolver().OpenAsset(Ar.ResolvedPath(path.resolvedPath)) if path.resolvedPath else None
            check(f"{name}: {path.path} does not resolve", asset is not None)
            if asset is not None:
                image = Image.open(io.BytesIO(bytes(asset.GetBuffer())))
                check(f"{name}: {image.mode}", image.mode == mode)
                same(name, np.asarray(image), mesh[name])
        for name in ("centaur:baseMap", "centaur:bandsMap"):
            attribute = prim.GetAttribute(name)
            check(f"{name} does not resolve", not attribute or bool(attribute.Get().resolvedPath))


def cameras(stage, expected):
    for camera in expected:
        prim = stage.GetPrimAtPath(camera["path"])
        unit = UsdGeom.GetStageMetersPerUnit(stage) / 10
        same(f"{camera['path']}: sensor", UsdGeom.Camera(prim).GetHorizontalApertureAttr().Get() * unit, 0.036, 1e-8)
        view = UsdGeom.Camera(prim).GetCamera(Usd.TimeCode.Default()).frustum
        matrix = view.ComputeViewMatrix() * view.ComputeProjectionMatrix()
        for point, pixel in camera["points"]:
            x, y, _ = matrix.Transform(Gf.Vec3d(*point))
            found = [(x + 1) / 2 * camera["width"], (1 - y) / 2 * camera["height"]]
            # Apertures are in single precision: 6e-8 of a thousand pixels, a few times.
            same(f"{camera['path']}: pixel", found, pixel, 1e-3)


def check_file(file, expected):
    stage = Usd.Stage.Open(file)
    check("up axis and units", UsdGeom.GetStageUpAxis(stage) == "Y" and UsdGeom.GetStageMetersPerUnit(stage) == 1)
    root = stage.GetDefaultPrim()
    check("default prim", root and root.GetPath() == "/Scene")
    for name, value in expected["composition"].items():
        same(name, root.GetAttribute(f"centaur:{name}").Get(), value)
    splats(stage, expected["splats"])
    meshes(stage, expected["meshes"])
    cameras(stage, expected["cameras"])
    for prim in stage.Traverse():
        known(prim)
    checker = UsdUtils.ComplianceChecker(arkit=False)
    checker.CheckCompliance(file)
    for fault in checker.GetErrors() + checker.GetFailedChecks() + checker.GetWarnings():
        check(f"ComplianceChecker: {fault}", False)
    for issue in vg035(file):
        check(f"VG.035: {issue}", False)


def broken_is_found(file):
    """A file that VG.035 must refuse, which shows that the rule is applied at all."""
    broken = str(pathlib.Path(file).with_name("broken.usda"))
    stage = Usd.Stage.Open(file)
    schema = UsdVol.ParticleField3DGaussianSplat(stage.GetPrimAtPath("/Scene/splats"))
    opacities = list(schema.GetOpacitiesAttr().Get())
    schema.GetOpacitiesAttr().Set(Vt.FloatArray([5.0] + opacities[1:]))
    stage.GetRootLayer().Export(broken)
    check("VG.035 finds nothing wrong with an opacity of 5", len(vg035(broken)) > 0)


def write_file(file, given):
    """Writes splats below a prim that is transformed by every kind of operation, in centimetres, z up."""
    stage = Usd.Stage.CreateNew(file)
    UsdGeom.SetStageUpAxis(stage, "Z")
    UsdGeom.SetStageMetersPerUnit(stage, 0.01)
    outer = UsdGeom.Xform.Define(stage, "/outer")
    stage.SetDefaultPrim(outer.GetPrim())
    outer.AddTranslateOp().Set((30, -20, 10))
    outer.AddTranslateOp(opSuffix="pivot").Set((1, 2, 3))
    outer.AddRotateXYZOp().Set((10, 20, -30))
    outer.AddRotateZYXOp(opSuffix="second").Set((40, -50, 60))
    outer.AddTranslateOp(opSuffix="pivot", isInverseOp=True)
    inner = UsdGeom.Xform.Define(stage, "/outer/inner")
    inner.AddOrientOp().Set(Gf.Quatf(0.5, 0.1, -0.7, 0.2).GetNormalized())
    inner.AddRotateYOp().Set(33)
    inner.AddScaleOp().Set((2, 2, 2))
    inner.AddTransformOp().Set(Gf.Matrix4d().SetRotate(Gf.Rotation(Gf.Vec3d(1, 2, 3), 77)) * Gf.Matrix4d().SetTranslate((4, 5, 6)))
    schema = UsdVol.ParticleField3DGaussianSplat.Define(stage, "/outer/inner/splats")
    schema.CreatePositionsAttr(Vt.Vec3fArray.FromNumpy(np.array(given["positions"], np.float32)))
    schema.CreateScalesAttr(Vt.Vec3fArray.FromNumpy(np.array(given["scales"], np.float32)))
    schema.CreateOpacitiesAttr(Vt.FloatArray.FromNumpy(np.array(given["opacities"], np.float32)))
    schema.CreateOrientationsAttr(Vt.QuatfArray([Gf.Quatf(*q) for q in given["orientations"]]))
    schema.CreateRadianceSphericalHarmonicsDegreeAttr(given["degree"])
    schema.CreateRadianceSphericalHarmonicsCoefficientsAttr(
        Vt.Vec3fArray.FromNumpy(np.array(given["coefficients"], np.float32)))
    camera = UsdGeom.Camera.Define(stage, "/outer/inner/view")
    camera.CreateFocalLengthAttr(30.0)
    camera.CreateHorizontalApertureOffsetAttr(2.0)
    stage.Save()
    cache = UsdGeom.XformCache()
    # From centimetres, z up, to metres, y up; rows are vectors.
    to_metres = Gf.Matrix4d(0.01, 0, 0, 0, 0, 0, -0.01, 0, 0, 0.01, 0, 0, 0, 0, 0, 1)
    world = cache.GetLocalToWorldTransform(schema.GetPrim()) * to_metres
    frustum = camera.GetCamera(Usd.TimeCode.Default()).frustum
    matrix = frustum.ComputeViewMatrix() * frustum.ComputeProjectionMatrix()
    pixels = []
    for p in given["positions"]:
        p = cache.GetLocalToWorldTransform(schema.GetPrim()).Transform(Gf.Vec3d(*p))
        pixels.append(list(matrix.Transform(p))[:2])
    print(json.dumps({"world": [list(row) for row in world], "ndc": pixels}))


mode, file, values = sys.argv[1:]
values = json.loads(pathlib.Path(values).read_text())
if mode == "write":
    write_file(file, values)
else:
    check_file(file, values)
    if file.endswith(".usda"):
        broken_is_found(file)
        Sdf.Layer.FindOrOpen(file).Export(str(pathlib.Path(file).with_suffix(".usdc")))
for fault in faults:
    print(f"{file}: {fault}", file=sys.stderr)
sys.exit(1 if faults else 0)
