# SPDX-License-Identifier: BSD-3-Clause
"""The task behind the tables: one method on one scene, and all that the answer depends on."""

import hashlib
import subprocess
import time
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from experiments import baselines
from experiments.baselines import method
from experiments.protocols import Method, Reconstruction, TrueScene
from experiments.reconstruction import evaluate_reconstruction
from experiments.scene_truth import SceneTruth
from experiments.tables.store import Case
from vprism_plan._resources import data_path
from vprism_plan.errors import ConfigError
from vprism_plan.mapping import MapConfig
from vprism_plan.perception.observation import Observation

# Raised by hand when the meaning of the code changes, and only then: what is stored stays
# valid through everything else. Of the scenes, of the scores, of each method.
SCENES, SCORES = 1, 1
_METHODS: dict[str, int] = {}  # 1 for what is not listed
# Methods that fit with a preset that may still be tuned: it is part of the question.
_PRESETS = {
    "vprism": MapConfig, "sgd": MapConfig, "sigmoid": MapConfig, "vprism-fine": MapConfig.fine,
    "vprism-flat": MapConfig,
}  # fmt: skip

# Trained, and so may be trained again; found without importing torch.
_POINTSDF = Path(baselines.__file__).parent / "pointsdf" / "weights.safetensors"
_SHAPES = data_path("shape_prior.safetensors")
_WEIGHTS = {
    "pointsdf": _POINTSDF, "network": _SHAPES, "vprism": _SHAPES, "vprism-fine": _SHAPES,
}  # fmt: skip


def method_question(key: str) -> dict[str, Any]:
    """Return what the answers of a method depend on besides the scene."""
    chosen = method(key)
    question: dict[str, Any] = {
        "key": key, "level": chosen.level, "version": _METHODS.get(key, 1),
    }  # fmt: skip
    if key in _PRESETS:
        question["config"] = asdict(_PRESETS[key]())
    weights = _WEIGHTS.get(key)
    if weights is not None and weights.is_file():  # without them the fit says how to get them
        question["weights"] = hashlib.sha256(weights.read_bytes()).hexdigest()[:16]
    return question


def scene_question(kind: str, seed: int, data: Path | None = None) -> dict[str, Any]:
    """Return what a generated scene depends on."""
    return {"set": kind, "seed": seed, "data": data_digest(kind, data), "version": SCENES}


def data_digest(kind: str, data: Path | None = None) -> str | None:
    """Return a digest of the meshes that were chosen for a set: their names and contents.

    None where nothing was chosen (see `generation.sources.chosen_folder`). Where a folder
    lies is no part of it: answers hold on any machine that has the same meshes.

    Raises:
        ConfigError: the folder is missing or holds no mesh.
    """
    from experiments.generation.sources import chosen_folder, meshes_in

    folder = chosen_folder(kind, data)
    if folder is None:
        return None
    digest = hashlib.sha256()
    meshes = meshes_in(folder)
    buffers = [path for path in folder.rglob("*") if path.suffix.lower() == ".bin"]  # of glTF
    for path in sorted((*meshes, *buffers)):
        found = path.stat()
        content = _content(path, found.st_size, found.st_mtime_ns)
        digest.update(f"{path.relative_to(folder).as_posix()}\0{content}\0".encode())
    return digest.hexdigest()[:20]


@lru_cache(maxsize=4096)
def _content(path: Path, size: int, changed: int) -> str:
    """Return the digest of a file, read again when size or time of change differ."""
    return f"{size} {hashlib.sha256(path.read_bytes()).hexdigest()}"


def whereabouts(kind: str, data: Path | None = None) -> dict[str, Any]:
    """Return where the chosen meshes of a set lie: what a case is `given`, not asked."""
    from experiments.generation.sources import chosen_folder

    folder = chosen_folder(kind, data)
    return {} if folder is None else {"data": str(folder)}


def cases(
    kind: str, seeds: Iterable[int], methods: Iterable[str], data: Path | None = None
) -> list[Case]:
    """Return one case per scene and method, those of a scene next to each other."""
    questions = [(key, method_question(key)) for key in methods]
    given = whereabouts(kind, data)
    return [
        Case(f"{kind}-{seed}-{key}", {"scene": scene, "method": question, "scores": SCORES}, given)
        for seed in seeds
        for scene in [scene_question(kind, seed, data)]
        for key, question in questions
    ]


def check_sets(kinds: Sequence[str], scenes: int, data: Path | None) -> None:
    """Raise ConfigError, before anything runs, if sets of scenes cannot be made."""
    from experiments.generation import source

    if scenes < 1:
        raise ConfigError(f"scenes is {scenes}; it must be at least 1")
    if not kinds:
        raise ConfigError("no set of scenes is named; give at least one")
    for kind in kinds:
        source(kind, data)


def cases_of_sets(
    kinds: Sequence[str], seeds: Iterable[int], methods: Sequence[str], data: Path | None
) -> list[Case]:
    """Return the cases of several sets.

    Seed by seed, so that a run that is cut short has as many scenes of every set.
    """
    return [case for seed in seeds for kind in kinds for case in cases(kind, [seed], methods, data)]


def scene_of(case: Case) -> tuple[str, int]:
    """Return what cases of the same scene have in common: how `sweep` groups them."""
    scene = case.asked["scene"]
    return scene["set"], scene["seed"]


def score(case: Case) -> dict[str, Any]:
    """Fit one method to one scene and score it: a task for `sweep`.

    The answer has the `scores` (`ReconstructionScores`), how many labelled objects the
    scene has, `seconds` of processor time of the fit and of predicting, how many points
    were predicted, the commit that computed it, and a digest of what the camera saw.
    """
    return scored(case, method(case.asked["method"]["key"]))


def scored(case: Case, chosen: Method) -> dict[str, Any]:
    """Return the answer of `score` for any method, on the scene that a case asks for."""
    scene, truth = prepared(case)
    began = time.process_time()
    found = _Timed(chosen.fit(scene.observation, scene.seed))
    fit_seconds = time.process_time() - began
    scores = evaluate_reconstruction(
        scene, found, chosen.level, continuous=chosen.continuous, truth=truth
    )
    return {
        "scene": scene.name,
        "objects": len(scene.object_ids),
        "scores": scores.to_dict(),
        "seconds": {"fit": fit_seconds, "predict": found.seconds},
        "predicted_points": found.points,
        "commit": commit(),
        "seen": _digest(scene.observation),
    }


def prepared(case: Case) -> tuple[TrueScene, SceneTruth]:
    """Return the scene that a case asks for, and its truth."""
    asked = case.asked["scene"]
    return _prepared(asked["set"], asked["seed"], asked["data"], case.given.get("data"))


@lru_cache(maxsize=1)
def _prepared(
    kind: str, seed: int, digest: str | None, folder: str | None
) -> tuple[TrueScene, SceneTruth]:
    """Make a scene and its truth once for all methods that follow each other."""
    from experiments.generation import generate

    scene = generate(kind, seed, data=None if folder is None else Path(folder))
    return scene, SceneTruth.of(scene)


class _Timed:
    """A reconstruction that adds up the processor time of its predictions."""

    def __init__(self, found: Reconstruction) -> None:
        self.found = found
        self.seconds = 0.0
        self.points = 0

    @property
    def object_ids(self) -> tuple[int, ...]:
        return self.found.object_ids

    def predict_proba(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n k"]:
        began = time.process_time()
        proba = self.found.predict_proba(points)
        self.seconds += time.process_time() - began
        self.points += len(points)
        return proba


def _digest(seen: Observation) -> str:
    """Tell scenes apart that a changed generator makes of the same seed."""
    digest = hashlib.sha256(np.ascontiguousarray(seen.depth).tobytes())
    digest.update(np.ascontiguousarray(seen.labels).tobytes())
    return digest.hexdigest()[:16]


@cache
def commit() -> str:
    """Return the commit of this code, "+" added where files differ; "unknown" outside git."""
    root = Path(__file__).resolve().parents[2]
    if not (root / ".git").exists():
        return "unknown"
    try:
        head = _git(root, "rev-parse", "--short=10", "HEAD")
        changed = _git(root, "status", "--porcelain", "--untracked-files=no", "--", "vprism_plan")
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return head + ("+" if changed else "")


def _git(root: Path, *arguments: str) -> str:
    done = subprocess.run(
        ["git", "-C", str(root), *arguments], capture_output=True, text=True, check=True
    )
    return done.stdout.strip()
