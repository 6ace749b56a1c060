"""The rig and the words of the fake: where the cameras stand, what it can be asked for."""

import json
from typing import Any

import numpy as np

from backend.contract.descriptions import MethodDescription, ShownDescription, StageDescription
from backend.contract.rigs import (
    CameraView,
    PinholeView,
    PoseView,
    ProjectorView,
    RigOffer,
    RigView,
)
from tests.ui.fake_methods import METHODS, FakeResult
from tests.ui.fake_scene import CAMERAS, scene


def describe(name: str) -> MethodDescription:
    title, doc, stages = METHODS[name]
    described = tuple(
        StageDescription(
            name=s.name, title=s.title, doc=s.doc, version=1, review=s.review, captures=s.captures, inputs=(), output="Result",
            settings=s.params.model_json_schema(),
            shown=tuple(ShownDescription(name=f.name, per_camera=f.per_camera, hint=f.hint) for f in s.make(s.params().model_dump(mode="json")).fields),
        )
        for s in stages
    )  # fmt: skip
    return MethodDescription(
        name=name, title=title, doc=doc, stages=described, given=("RigFacts",), presets={"fast": {}}
    )


def rig_view(options: dict[str, Any]) -> RigView:
    s = scene()
    K = tuple(map(tuple, s.intrinsics()))
    model = PinholeView(width_px=s.width_px, height_px=s.height_px, K=K, distortion=(0.0,) * 5)
    R, t = s.right_from_left()
    identity = PoseView(R=((1, 0, 0), (0, 1, 0), (0, 0, 1)), t_mm=(0, 0, 0))
    poses = {"left": identity, "right": PoseView(R=tuple(map(tuple, R)), t_mm=tuple(t))}
    cameras = tuple(
        CameraView(
            name=c,
            width_px=s.width_px,
            height_px=s.height_px,
            bit_depth=8,
            exposure_min_ms=0.1,
            exposure_max_ms=1000,
            model=model,
            camera_from_world=poses[c],
        )
        for c in CAMERAS
    )
    half = s.toe_in_rad / 2
    c, sn = np.cos(half), np.sin(half)
    projector_R = np.array([[c, 0, sn], [0, 1, 0], [-sn, 0, c]])
    centre = 90.0 * np.array([np.cos(half), 0, np.sin(half)]) + np.array([0, -40.0, 0])
    pose = PoseView(R=tuple(map(tuple, projector_R)), t_mm=tuple(-projector_R @ centre))
    K_p = ((1.75 * 1280, 0.0, 639.5), (0.0, 1.75 * 1280, 399.5), (0.0, 0.0, 1.0))
    projector = ProjectorView(
        width_px=1280,
        height_px=800,
        frame_period_ms=8.3333,
        model=PinholeView(width_px=1280, height_px=800, K=K_p, distortion=(0.0,) * 5),
        projector_from_world=pose,
    )
    return RigView(
        name="simulated",
        title="Simulated rig",
        options=options,
        reference="left",
        cameras=cameras,
        projector=projector,
    )


OPTIONS_SCHEMA = {
    "type": "object",
    "properties": {
        "scene": {"title": "Scene", "enum": ["high-contrast", "metal", "workpieces", "sphere"], "default": "high-contrast"},
        "width_px": {"title": "Width", "type": "integer", "minimum": 320, "maximum": 2592, "default": 1280, "unit": "px"},
        "height_px": {"title": "Height", "type": "integer", "minimum": 240, "maximum": 1944, "default": 960, "unit": "px"},
        "seed": {"title": "Noise seed", "type": "integer", "default": 1},
    },
}  # fmt: skip

OFFERS = (
    RigOffer(name="simulated", title="Simulated rig", doc="Ray-cast scenes.", options_schema=OPTIONS_SCHEMA),
    RigOffer(name="broken", title="Broken rig", doc="", options_schema={}, error="No module named 'vendor_sdk'."),
)  # fmt: skip


def pack_points(result: FakeResult, budget: int) -> bytes:
    by_name = {f.name: f for f in result.fields}
    points = next(f for f in result.fields if f.hint["kind"] == "points")
    xyz = points.arrays[""]
    step = max(1, -(-len(xyz) // budget))
    scalars = {n: by_name[n].arrays[""][::step] for n in points.hint["scalars"]}
    facts = {
        n: {
            "unit": by_name[n].hint["unit"],
            "title": by_name[n].hint["title"],
            "low": float(np.percentile(v, 1)),
            "high": float(np.percentile(v, 99)),
        }
        for n, v in scalars.items()
    }
    header = json.dumps({"n": len(xyz[::step]), "total": len(xyz), "scalars": facts}).encode()
    parts = [
        len(header).to_bytes(4, "little"),
        header,
        xyz[::step].astype("<f4").tobytes(),
        by_name["colour"].arrays[""][::step].tobytes(),
    ]
    return b"".join(parts + [v.astype("<f4").tobytes() for v in scalars.values()])
