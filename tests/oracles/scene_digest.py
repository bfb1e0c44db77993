"""Every bit of a generated scene in one hash."""

import hashlib


def digest(scene) -> str:
    state = hashlib.sha256()
    for body in scene.objects:
        for part in (body.vertices, body.faces, body.pose):
            state.update(part.tobytes())
        state.update(body.name.encode())
    seen = scene.observation
    for part in (seen.depth, seen.labels, seen.color, seen.T_world_camera, seen.intrinsics):
        state.update(part.tobytes())
    return state.hexdigest()
