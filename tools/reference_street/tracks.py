"""Sparse points as structure from motion finds them on photos with known poses."""

import os
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Int

if TYPE_CHECKING:
    from climatenerf.scene import Camera, View

FEATURES, SEED = 4096, 0  # as `climatenerf capture`


def sfm_points(
    views: Sequence["View"], camera: "Camera", work: Path
) -> tuple[Float[np.ndarray, "n 3"], list[Int[np.ndarray, "k"]]]:
    """Match photos as `climatenerf capture` does, and triangulate with their true poses.

    Wrong matches and the errors of features stay in the points. The poses are not estimated.

    Args:
        views: the photos and their true poses.
        camera: the pinhole camera of all photos.
        work: work folder; a repeated call resumes.

    Returns:
        Points in the frame of the poses, and for each view the indices of the points it observes.
    """
    from climatenerf.sfm.photo_import import import_photos
    from climatenerf.sfm.reconstruct import DATABASE, load_pycolmap, match_pictures
    from climatenerf.sfm.worker import WORKER_ENVIRONMENT

    os.environ |= WORKER_ENVIRONMENT  # equal runs give equal matches
    photos, done = work / "photos", work / "matches"
    for folder in (photos, done):
        folder.mkdir(parents=True, exist_ok=True)
    for view in views:
        shutil.copy2(view.path, photos / view.name)
    pycolmap = load_pycolmap()
    imported = import_photos(photos, done, lambda *_: None)
    match_pictures(pycolmap, imported, done, FEATURES, SEED, lambda *_: None)

    by_name = {view.name: view for view in views}
    model = pycolmap.Reconstruction()
    with pycolmap.Database.open(done / DATABASE) as database:
        (entry,) = database.read_all_cameras()
        # The database has this model, which equals the pinhole camera without distortion.
        lens = [camera.fx, camera.cx, camera.cy, 0.0]
        known = pycolmap.Camera(
            camera_id=entry.camera_id, model="SIMPLE_RADIAL", params=lens,
            width=camera.width, height=camera.height,
        )  # fmt: skip
        model.add_camera_with_trivial_rig(known)
        for image in database.read_all_images():
            pose = pycolmap.Rigid3d(np.linalg.inv(by_name[image.name].c2w)[:3])
            posed = pycolmap.Image(
                name=image.name, image_id=image.image_id, camera_id=image.camera_id
            )
            model.add_image_with_trivial_frame(posed, pose)
    pycolmap.set_random_seed(SEED)
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = SEED
    options.num_threads = 1
    shutil.rmtree(work / "model", ignore_errors=True)
    (work / "model").mkdir()
    found = pycolmap.triangulate_points(
        model, done / DATABASE, imported.folder, work / "model", options=options
    )
    ids = sorted(found.point3D_ids())
    seen: dict[str, set[int]] = {name: set() for name in by_name}
    for index, number in enumerate(ids):
        for element in found.point3D(number).track.elements:
            seen[found.image(element.image_id).name].add(index)
    points = np.array([found.point3D(number).xyz for number in ids])
    return points, [np.array(sorted(seen[view.name]), int) for view in views]
